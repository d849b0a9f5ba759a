// Charts of the page as traces of plotly.js, with a common zoom of the charts of one antenna; a sky plot of the chosen
// epoch next to the charts; tables as CSV files.
"use strict";
(function () {
  const LIGHT = { ink: "#1b1b1b", grid: "#e3e3e3", axis: "#767676", paper: "#ffffff" };
  const DARK = { ink: "#e8e8e8", grid: "#343a41", axis: "#8d959e", paper: "#14181c" };
  const FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', Arial, sans-serif";
  const MARGIN = { l: 66, r: 14, t: 8, b: 50 };
  // formats of the times along an axis, by the interval between two of them [ms]; the date is in the title of the axis
  const CLOCKS = [[null, 1e3, "%H:%M:%S.%2f"], [1e3, 6e4, "%H:%M:%S"], [6e4, 864e5, "%H:%M"], [864e5, null, "%Y-%m-%d"]]
    .map(([low, high, value]) => ({ dtickrange: [low, high], value }));
  const PRINTED = { wide: 700, half: 340 }; // widths on paper [px]
  const darkness = window.matchMedia("(prefers-color-scheme: dark)");
  const plots = [], skies = {};
  let printing = false;
  const theme = () => darkness.matches && !printing ? DARK : LIGHT;

  // Return the colour of a layer, which is lighter on a dark page.
  function tone(colour) {
    if (theme() === LIGHT) return colour;
    if (colour === "#000000") return DARK.ink;
    return "#" + [1, 3, 5].map(i => Math.round(parseInt(colour.slice(i, i + 2), 16) * 0.6 + 255 * 0.4).toString(16).padStart(2, "0")).join("");
  }

  // ---- arrays of the page: float32 or unsigned integers, little endian, in base 64
  function numbers(packed) {
    const kinds = { f: Float32Array, h: Uint16Array, i: Uint32Array };
    const raw = atob(packed.slice(1)), bytes = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) bytes[i] = raw.charCodeAt(i);
    return new kinds[packed[0]](bytes.buffer);
  }
  function unpack(chart) {
    for (const layer of chart.layers)
      for (const key of ["x", "y", "low", "mid", "high", "left", "right", "height", "epoch", "a", "b", "n"])
        if (typeof layer[key] === "string") layer[key] = numbers(layer[key]);
    return chart;
  }
  function clock(seconds) { return new Date(Math.round(seconds * 1e3)).toISOString().slice(11, 21); }
  function date(seconds) { return new Date(seconds * 1e3).toISOString().slice(0, 10); }

  // ---- axes: symlog values are scaled here, because plotly has no axis that is linear near zero and logarithmic beyond
  function scaled(chart) {
    if (chart.y_scale !== "symlog") return v => v;
    const linear = chart.y_linear;
    return v => Math.abs(v) <= linear ? v / linear : Math.sign(v) * (1 + Math.log10(Math.abs(v) / linear));
  }
  function symlogTicks(chart) {
    const to = scaled(chart), values = [0, chart.y_linear / 2, chart.y_linear];
    for (let k = Math.floor(Math.log10(chart.y_linear)) + 1; k < 9; k++) if (10 ** k > 1.5 * chart.y_linear) values.push(10 ** k);
    const both = [...values.slice(1).map(v => -v).reverse(), ...values];
    return { tickmode: "array", tickvals: both.map(to), ticktext: both.map(v => v.toLocaleString("en").replace("-", "\u2212")) };
  }
  const abscissa = (chart, x) => chart.start === undefined ? x : Float64Array.from(x, v => 1e3 * (chart.start + v));
  const ordinate = (chart, y) => chart.y_scale === "symlog" ? Float32Array.from(y, scaled(chart)) : y;

  // ---- layers as traces
  const SYMBOLS = { dot: "circle", square: "square-open", cross: "x-thin-open", ring: "circle-open" };
  const DASHES = { solid: "solid", dashed: "dash", dotted: "dot" };
  function hover(chart, name) {
    const x = chart.start === undefined ? "%{x:,.2f}" : "%{x|%H:%M:%S.%1f}";
    return `${name || chart.title}<br>${chart.x_label} ${x}<br>${chart.y_label} %{customdata:,.3~f}<extra></extra>`;
  }
  const TRACES = {
    points(chart, layer) {
      const colour = tone(layer.colour);
      return { mode: "markers", x: abscissa(chart, layer.x), y: ordinate(chart, layer.y), customdata: layer.y,
        hovertemplate: hover(chart, layer.label),
        marker: { symbol: SYMBOLS[layer.shape], size: layer.size + (layer.shape === "dot" ? 1 : 2), color: colour, line: { color: colour, width: 1 } } };
    },
    line(chart, layer) {
      return { mode: "lines", x: abscissa(chart, layer.x), y: ordinate(chart, layer.y), customdata: layer.y,
        hovertemplate: hover(chart, layer.label), line: { color: tone(layer.colour), width: layer.width, dash: DASHES[layer.dash] } };
    },
    band(chart, layer) { // each stretch without a gap is one closed outline
      const x = [], y = [], at = abscissa(chart, layer.x), low = ordinate(chart, layer.low), high = ordinate(chart, layer.high);
      for (let i = 0; i < at.length;) {
        let j = i;
        while (j < at.length && low[j] === low[j] && at[j] === at[j]) j++;
        if (j === i) { i++; continue; }
        for (let k = i; k < j; k++) { x.push(at[k]); y.push(high[k]); }
        for (let k = j - 1; k >= i; k--) { x.push(at[k]); y.push(low[k]); }
        x.push(null); y.push(null);
        i = j;
      }
      return { mode: "lines", x, y, fill: "toself", fillcolor: tone(layer.colour) + "40", line: { width: 0, color: tone(layer.colour) }, hoverinfo: "skip" };
    },
    bars(chart, layer) {
      const middle = layer.left.map((v, i) => (v + layer.right[i]) / 2), width = layer.left.map((v, i) => layer.right[i] - v);
      return { type: "bar", x: middle, y: layer.height, width, marker: { color: tone(layer.colour) + "aa" },
        customdata: middle.map((_, i) => i), text: Array.from(layer.left, (v, i) => `${v.toFixed(2)} to ${layer.right[i].toFixed(2)}`), textposition: "none",
        hovertemplate: `${layer.label}<br>%{text}: %{y:,.0f}<extra></extra>` };
    },
    cells(chart, layer) {
      const step = (low, high, many) => Array.from({ length: many }, (_, i) => low + (high - low) * (i + 0.5) / many);
      const z = Array.from({ length: layer.ny }, () => new Array(layer.nx).fill(null)), counts = z.map(row => row.slice());
      for (let i = 0; i < layer.n.length; i++) {
        z[layer.b[i]][layer.a[i]] = Math.log(1 + layer.n[i]);
        counts[layer.b[i]][layer.a[i]] = layer.n[i];
      }
      const grey = theme() === LIGHT ? ["#d7d7d7", "#141414"] : ["#3c3c3c", "#f0f0f0"];
      return { type: "heatmap", x: step(layer.x0, layer.x1, layer.nx), y: step(layer.y0, layer.y1, layer.ny), z, customdata: counts, zmin: 0,
        zmax: Math.log(1 + layer.most), colorscale: [[0, grey[0]], [1, grey[1]]], showscale: false, hoverongaps: false,
        hovertemplate: `%{customdata:,} ${layer.label}<br>${chart.x_label} %{x:.2f}<br>${chart.y_label} %{y:.2f}<extra></extra>` };
    },
    ranges(chart, layer) {
      const rows = layer.names.map((_, i) => i).filter(i => layer.mid[i] === layer.mid[i]);
      const told = rows.map(i => `${layer.names[i]}<br>lowest ${layer.low[i].toFixed(2)}<br>mean ${layer.mid[i].toFixed(2)}<br>highest ${layer.high[i].toFixed(2)}`);
      return { type: "bar", orientation: "h", base: rows.map(i => layer.low[i]), x: rows.map(i => layer.high[i] - layer.low[i]), y: rows, width: 0.5,
        marker: { color: tone(layer.colour) + "90" }, text: told, textposition: "none", hovertemplate: "%{text}<extra></extra>" };
    },
    marks(chart, layer) {
      const colour = tone(layer.colour), beside = layer.place === "beside";
      return { mode: beside ? "markers+text" : "text", x: abscissa(chart, layer.x), y: ordinate(chart, layer.y), hoverinfo: "text", hovertext: layer.words,
        text: layer.words.map(word => word.replace(/\n/g, "<br>")), textposition: beside ? "top right" : "middle center", textfont: { color: colour },
        marker: { symbol: "cross-thin-open", size: 8, color: colour, line: { color: colour, width: 1.5 } } };
    }
  };
  function meanMarks(chart, layer) { // marks at the means of range bars
    const rows = layer.names.map((_, i) => i).filter(i => layer.mid[i] === layer.mid[i]);
    return { mode: "markers", x: rows.map(i => layer.mid[i]), y: rows, showlegend: false, hoverinfo: "skip",
      marker: { symbol: "line-ns-open", size: 16, color: tone(layer.colour), line: { width: 3, color: tone(layer.colour) } } };
  }

  // ---- one chart
  function Plot(figure) {
    this.figure = figure;
    this.div = figure.querySelector(".plot");
  }
  Plot.prototype.load = function () {
    if (!this.chart) this.chart = unpack(JSON.parse(document.getElementById(this.figure.dataset.chart).textContent));
    return this.chart;
  };
  Plot.prototype.traces = function () {
    const chart = this.load(), traces = [], seen = new Set();
    this.layers = []; // the layer of each trace, by index of the trace
    for (const layer of chart.layers) {
      const first = Boolean(layer.label) && !seen.has(layer.label);
      seen.add(layer.label);
      traces.push({ type: "scatter", name: layer.label, legendgroup: layer.label || undefined, showlegend: first, ...TRACES[layer.kind](chart, layer) });
      this.layers.push(layer);
      if (layer.kind === "ranges") { traces.push({ type: "scatter", legendgroup: layer.label, ...meanMarks(chart, layer) }); this.layers.push(layer); }
    }
    return traces;
  };
  Plot.prototype.layout = function () {
    const chart = this.load(), t = theme(), half = this.figure.classList.contains("half");
    const names = chart.layers.find(layer => layer.kind === "ranges"), labels = new Set(chart.layers.map(layer => layer.label).filter(Boolean));
    const base = names ? 110 + 26 * names.names.length : chart.equal ? (half ? 360 : 500) : half ? 320 : 350;
    const width = printing ? PRINTED[half ? "half" : "wide"] : this.div.clientWidth;
    // A title that is longer than its axis has two lines, and the margin one line more.
    const high = base - MARGIN.t - MARGIN.b, long = 7 * chart.y_label.length > high, middle = chart.y_label.length / 2;
    const gaps = [...chart.y_label.matchAll(/ /g)].map(found => found.index).sort((a, b) => Math.abs(a - middle) - Math.abs(b - middle));
    const yTitle = long && gaps.length ? chart.y_label.slice(0, gaps[0]) + "<br>" + chart.y_label.slice(gaps[0] + 1) : chart.y_label;
    const widest = names ? Math.max(...names.names.map(name => name.length)) : 0;
    this.left = names ? Math.max(MARGIN.l, Math.min(14 + 6.6 * widest, width / 2)) : MARGIN.l + (yTitle === chart.y_label ? 0 : 17);
    // The number of rows of the legend below the axis is estimated from the number of letters of its entries.
    const row = Math.max(20, (width - this.left - MARGIN.r) / 6.6), letters = [...labels].map(label => 8 + label.length);
    this.below = MARGIN.b + 21 * letters.reduce(([rows, used], wide) => used + wide > row ? [rows + 1, wide] : [rows, used + wide], [letters.length ? 1 : 0, 0])[0];
    const height = base + this.below - MARGIN.b;
    const axis = { gridcolor: t.grid, linecolor: t.axis, zeroline: false, showline: true, mirror: true, exponentformat: "none", separatethousands: true,
      minorloglabels: "complete" };
    const x = { ...axis, title: { standoff: 4, text: chart.start === undefined ? chart.x_label : `${chart.x_label}, ${date(chart.start)}` } };
    if (chart.start !== undefined) Object.assign(x, { type: "date", tickformatstops: CLOCKS }); else if (chart.x_scale === "log") x.type = "log";
    if (chart.x_range) x.range = abscissa(chart, chart.x_range);
    const y = { ...axis, title: { text: yTitle } };
    if (chart.y_scale === "log") y.type = "log";
    if (chart.y_scale === "symlog") Object.assign(y, symlogTicks(chart));
    if (chart.y_range) y.range = [...ordinate(chart, chart.y_range)];
    if (chart.equal) Object.assign(y, { scaleanchor: "x", scaleratio: 1 });
    if (names) Object.assign(y, { tickmode: "array", tickvals: names.names.map((_, i) => i), ticktext: names.names, autorange: "reversed" });
    return { height, width: width || undefined, margin: { ...MARGIN, l: this.left, b: this.below }, paper_bgcolor: t.paper,
      plot_bgcolor: t.paper, font: { family: FONT, size: 12, color: t.ink }, xaxis: x, yaxis: y, hovermode: "closest", dragmode: "zoom",
      barmode: "overlay", legend: { orientation: "h", x: 0, yref: "container", y: 0, yanchor: "bottom", itemsizing: "constant", tracegroupgap: 0 }, shapes: this.chosenShapes(),
      uirevision: "kept", annotations: chart.equal ? [{ text: "N\u2191", xref: "paper", yref: "paper", x: 0.99, y: 0.98, showarrow: false, bgcolor: t.paper }] : [] };
  };
  Plot.prototype.draw = function () {
    const traces = this.traces(), drawn = Boolean(this.figure.dataset.drawn);
    Plotly.react(this.div, traces, this.layout(), { displaylogo: false, doubleClick: "reset+autosize",
      modeBarButtonsToRemove: ["lasso2d", "select2d", "toImage"] });
    this.figure.dataset.drawn = traces.reduce((sum, trace) => sum + (trace.z ? 1 : trace.x.length), 0);
    if (!drawn) this.listen();
    this.thin();
  };
  // Return the visible range of an axis in the units of the data, which are milliseconds since 1970 on a time axis.
  Plot.prototype.range = function (name) {
    const range = this.div.layout[name].range, isTime = name === "xaxis" && this.chart.start !== undefined;
    return isTime ? range.map(v => typeof v === "number" ? v : Date.parse(String(v).replace(" ", "T") + "Z")) : range.map(Number);
  };
  Plot.prototype.isWhole = function () { return !this.zoomed; };
  Plot.prototype.listen = function () {
    this.div.on("plotly_relayout", change => {
      if (this.following || !Object.keys(change).some(key => key.startsWith("xaxis") || key.startsWith("yaxis"))) return;
      this.zoomed = !Object.keys(change).some(key => key.endsWith("autorange")) && !("xaxis.showspikes" in change);
      this.thin();
      together(this);
    });
    this.div.on("plotly_click", event => {
      const point = event.points[0], layer = this.layers[point.curveNumber];
      if (layer.epoch && skies[this.figure.dataset.sky]) choose(this.figure.dataset.sky, (this.chart.epoch0 || 0) + layer.epoch[point.pointNumber], this.figure);
    });
    new ResizeObserver(() => { // the number of rows of the legend depends on the width
      const wide = this.div.clientWidth, layout = this.layout();
      if (!printing && wide && this.div.layout.width !== wide) Plotly.relayout(this.div, { width: wide, height: layout.height, "margin.b": this.below, "margin.l": this.left });
    }).observe(this.div);
    this.div.addEventListener("keydown", event => {
      const sky = skies[this.figure.dataset.sky], step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (event.key === "0") Plotly.relayout(this.div, { "xaxis.autorange": true, "yaxis.autorange": true });
      else if (event.key === "+" || event.key === "=" || event.key === "-") this.scale(event.key === "-" ? 2 : 0.5, 0);
      else if (step && (event.shiftKey || !sky)) this.scale(1, 0.2 * step);
      else if (step) choose(this.figure.dataset.sky, sky.time(sky.at() + step), this.figure);
      else if (event.key === "Enter" && sky) choose(this.figure.dataset.sky, this.middleEpoch(sky), this.figure);
      else if (event.key === "Escape" && sky) sky.close();
      else return;
      event.preventDefault();
    });
  };
  Plot.prototype.scale = function (factor, shift) {
    const [low, high] = this.range("xaxis"), middle = (low + high) / 2 + shift * (high - low), half = (high - low) / 2 * factor;
    Plotly.relayout(this.div, { "xaxis.range": [middle - half, middle + half] });
  };
  Plot.prototype.middleEpoch = function (sky) {
    const seen = this.seenEpochs();
    return seen.length ? seen[Math.floor(seen.length / 2)] : sky.time(0);
  };
  Plot.prototype.epochLayers = function () { return this.load().layers.filter(layer => layer.kind === "points" && layer.epoch); };
  // Return the epochs of the points inside the visible ranges, in order of time [s since 1970].
  Plot.prototype.seenEpochs = function () {
    const chart = this.load(), [x0, x1] = this.range("xaxis"), [y0, y1] = this.range("yaxis"), out = [];
    for (const layer of this.epochLayers()) {
      const x = abscissa(chart, layer.x);
      for (let i = 0; i < x.length; i++)
        if (x[i] >= x0 && x[i] <= x1 && (!chart.equal || (layer.y[i] >= y0 && layer.y[i] <= y1))) out.push((chart.epoch0 || 0) + layer.epoch[i]);
    }
    return Float64Array.from(out).sort();
  };
  // Hide the labels that would overlap others at the present scale.
  Plot.prototype.thin = function () {
    this.layers.forEach((layer, k) => {
      if (layer.kind !== "marks" || layer.words.some(word => word.includes("\n"))) return;
      const [x0, x1] = this.range("xaxis"), [y0, y1] = this.range("yaxis"), taken = [];
      const wide = this.div.clientWidth - this.left - MARGIN.r, high = this.div.clientHeight - MARGIN.t - this.below;
      const text = layer.words.map((word, i) => {
        const at = (layer.x[i] - x0) / (x1 - x0) * wide, y = (layer.y[i] - y0) / (y1 - y0) * high;
        const x = layer.place === "on" ? at - 3.5 * word.length : at + 8, end = x + 7 * word.length + 4;
        if (at < 0 || at > wide || y < 0 || y > high || taken.some(t => x < t[1] && end > t[0] && Math.abs(y - t[2]) < 15)) return "";
        taken.push([x, end, y]);
        return word.replace(/\n/g, "<br>");
      });
      this.figure.dataset.labels = taken.length;
      Plotly.restyle(this.div, { text: [text] }, [k]);
    });
  };
  // Return the mark of the chosen epoch: a vertical line on a time axis, otherwise a ring around the point.
  Plot.prototype.chosenShapes = function () {
    const sky = skies[this.figure.dataset.sky], seconds = sky && sky.chosen;
    if (seconds === undefined || seconds === null || !sky) return [];
    const line = { color: theme().ink, width: 1.5 };
    if (this.load().start !== undefined) return [{ type: "line", x0: 1e3 * seconds, x1: 1e3 * seconds, yref: "paper", y0: 0, y1: 1, line }];
    let best = null, least = 1;
    for (const layer of this.epochLayers()) for (let i = 0; i < layer.epoch.length; i++) {
      const away = Math.abs((this.chart.epoch0 || 0) + layer.epoch[i] - seconds);
      if (away < least) { least = away; best = [layer.x[i], scaled(this.chart)(layer.y[i])]; }
    }
    if (!best) return [];
    return [{ type: "circle", xsizemode: "pixel", ysizemode: "pixel", xanchor: best[0], yanchor: best[1], x0: -8, x1: 8, y0: -8, y1: 8, line }];
  };

  // ---- after a zoom, charts with the same axis show the same range, and other charts of the antenna the same epochs
  function together(source) {
    const { zoom, linked } = source.figure.dataset, others = plots.filter(plot => plot !== source && plot.chart && plot.figure.dataset.drawn);
    const epochs = linked && source.zoomed ? source.seenEpochs() : null;
    for (const plot of others) {
      const same = zoom && plot.figure.dataset.zoom === zoom;
      if (!same && !(linked && plot.figure.dataset.linked === linked)) continue;
      plot.following = true;
      plot.zoomed = source.zoomed;
      const reset = { "xaxis.autorange": !plot.chart.x_range, "yaxis.autorange": plot.chart.y_range ? false : plot.layers.some(l => l.kind === "ranges") ? "reversed" : true };
      if (plot.chart.x_range) reset["xaxis.range"] = abscissa(plot.chart, plot.chart.x_range);
      if (plot.chart.y_range) reset["yaxis.range"] = [...ordinate(plot.chart, plot.chart.y_range)];
      const change = !source.zoomed ? reset : same ? { "xaxis.range": source.range("xaxis") } : plot.around(epochs);
      Promise.resolve(change && Plotly.relayout(plot.div, change)).then(() => { plot.following = false; plot.thin(); });
    }
  }
  // Return the axis ranges that contain the points of some epochs; null if the chart has none of these epochs.
  Plot.prototype.around = function (epochs) {
    if (!epochs || !epochs.length) return null;
    const gap = Math.max(2, (epochs[epochs.length - 1] - epochs[0]) / 50), low = [Infinity, Infinity], high = [-Infinity, -Infinity];
    const seen = seconds => { // charts are thinned: an epoch between two near epochs of the other chart counts as one of them
      let a = 0, b = epochs.length;
      while (a < b) { const m = (a + b) >> 1; if (epochs[m] < seconds) a = m + 1; else b = m; }
      return a < epochs.length && epochs[a] === seconds || a > 0 && a < epochs.length && epochs[a] - epochs[a - 1] <= gap;
    };
    for (const layer of this.epochLayers()) {
      const x = abscissa(this.chart, layer.x);
      for (let i = 0; i < x.length; i++) {
        if (x[i] !== x[i] || layer.y[i] !== layer.y[i] || !seen((this.chart.epoch0 || 0) + layer.epoch[i])) continue;
        [x[i], layer.y[i]].forEach((v, k) => { low[k] = Math.min(low[k], v); high[k] = Math.max(high[k], v); });
      }
    }
    if (low[0] > high[0]) return null;
    const pad = k => Math.max((high[k] - low[k]) * 0.05, this.chart.start === undefined ? 5 : 500);
    const change = { "xaxis.range": [low[0] - pad(0), high[0] + pad(0)] };
    if (this.chart.equal) change["yaxis.range"] = [low[1] - pad(1), high[1] + pad(1)];
    return change;
  };

  // ---- sky plot and table of satellites of one epoch, which are shown next to the charts after an epoch was chosen
  function Sky(figure) {
    this.figure = figure;
    this.picture = figure.querySelector("svg");
    this.slider = figure.querySelector("input");
    this.said = figure.querySelector("output");
    this.rows = figure.querySelector("tbody");
    this.data = null;
    this.chosen = null;
    skies[figure.id] = this;
    this.slider.addEventListener("input", () => choose(figure.id, this.time(this.at())));
    figure.querySelector(".before").addEventListener("click", () => choose(figure.id, this.time(this.at() - 1)));
    figure.querySelector(".after").addEventListener("click", () => choose(figure.id, this.time(this.at() + 1)));
    figure.querySelector(".close").addEventListener("click", () => this.close());
    figure.addEventListener("keydown", event => { if (event.key === "Escape") this.close(); });
  }
  Sky.prototype.load = function () {
    if (this.data) return this.data;
    this.data = JSON.parse(document.getElementById(this.figure.dataset.chart).textContent);
    for (const key of ["epoch", "first", "satellite", "signal", "azimuth", "elevation", "cn0", "reason"]) this.data[key] = numbers(this.data[key]);
    this.slider.max = this.data.epoch.length - 1;
    return this.data;
  };
  Sky.prototype.at = function () { return Number(this.slider.value); };
  Sky.prototype.time = function (k) {
    const data = this.load();
    return data.start + data.epoch[Math.max(0, Math.min(data.epoch.length - 1, k))];
  };
  Sky.prototype.nearest = function (seconds) {
    const data = this.load();
    let best = 0;
    for (let i = 1; i < data.epoch.length; i++)
      if (Math.abs(data.start + data.epoch[i] - seconds) < Math.abs(data.start + data.epoch[best] - seconds)) best = i;
    return best;
  };
  Sky.prototype.close = function () {
    this.figure.classList.remove("docked");
    makeRoom();
    this.chosen = null;
    mark(this.figure.id);
  };
  Sky.prototype.draw = function () {
    const data = this.load(), k = this.at(), order = [];
    for (let i = data.first[k]; i < data.first[k + 1]; i++) order.push(i);
    order.sort((a, b) => (data.reason[a] === 0 ? 0 : 1) - (data.reason[b] === 0 ? 0 : 1) || data.satellite[a] - data.satellite[b]);
    const used = order.filter(i => data.reason[i] === 0).length, moment = this.time(k);
    let text = `${date(moment)} ${clock(moment)}: ${used} signals used, ${order.length - used} rejected`;
    if (this.chosen !== null && Math.abs(this.chosen - moment) > 0.05)
      text = `this page has no observations at ${clock(this.chosen)}; the nearest epoch with observations: ${text}`;
    this.said.textContent = text;
    const cn0 = i => data.cn0[i] === 65535 ? NaN : data.cn0[i] / 100;
    this.picture.replaceChildren(...skyMarks(order.map(i => ({ name: data.names[data.satellite[i]], azimuth: data.azimuth[i] / 100,
      elevation: data.elevation[i] / 100, cn0: cn0(i), used: data.reason[i] === 0, reason: data.reasons[data.reason[i]] }))));
    this.rows.replaceChildren(...order.map(i => {
      const row = document.createElement("tr");
      for (const [text, right] of [[data.names[data.satellite[i]]], [data.signals[data.signal[i]]], [(data.elevation[i] / 100).toFixed(0), 1],
        [(data.azimuth[i] / 100).toFixed(0), 1], [cn0(i) === cn0(i) ? cn0(i).toFixed(1) : "", 1], [data.reasons[data.reason[i]]]]) {
        const cell = row.insertCell();
        cell.textContent = text;
        if (right) cell.className = "n";
      }
      return row;
    }));
    this.figure.dataset.drawn = order.length;
  };
  function svg(tag, attributes, text) {
    const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    if (text !== undefined) element.textContent = text;
    return element;
  }
  // Return the elements of a sky plot with north up and a radius of 90 deg minus elevation.
  function skyMarks(satellites) {
    const out = [90, 60, 30].map(r => svg("circle", { class: "grid", r }));
    out.push(svg("path", { class: "grid", d: "M-90 0H90M0-90V90" }));
    for (const [name, x, y] of [["N", 0, -95], ["E", 96, 2], ["S", 0, 99], ["W", -96, 2]]) out.push(svg("text", { x, y, "text-anchor": "middle" }, name));
    const at = one => { const turn = one.azimuth * Math.PI / 180, away = 90 - one.elevation; return [away * Math.sin(turn), -away * Math.cos(turn)]; };
    // Each label has the place next to its satellite where it covers the fewest other labels and satellites.
    const taken = satellites.map(one => { const [x, y] = at(one); return [x - 2.5, y + 2, 5]; });
    for (const one of satellites) {
      const [x, y] = at(one);
      const group = svg("g", { class: one.used ? "used" : "left-out" }), name = one.name + (one.cn0 === one.cn0 ? " " + one.cn0.toFixed(0) : "");
      group.append(svg("title", {}, `${name}: ${one.reason}`));
      group.append(one.used ? svg("circle", { cx: x, cy: y, r: 2.4 }) : svg("path", { d: `M${x - 2} ${y - 2}l4 4m0-4l-4 4` }));
      const wide = 3.3 * name.length, left = x - 4 - wide, middle = x - wide / 2, right = x + 4;
      const places = [[right, y + 2], [left, y + 2], [middle, y - 4], [middle, y + 8], [right, y - 3], [right, y + 7], [left, y - 3], [left, y + 7], [middle, y - 9], [middle, y + 13]];
      const covered = p => taken.filter(t => p[0] < t[0] + t[2] && p[0] + wide > t[0] && Math.abs(p[1] - t[1]) < 5.5).length + (Math.abs(middle) + wide / 2 > 106 && Math.abs(p[0] + wide / 2) + wide / 2 > 106 ? 1 : 0);
      const place = places.reduce((best, p) => covered(p) < covered(best) ? p : best);
      taken.push([place[0], place[1], wide]);
      group.append(svg("text", { x: place[0], y: place[1] }, name));
      out.push(group);
    }
    return out;
  }
  // Show the sky plot `id` at an epoch. The panel first covers the page; the charts then become narrower, and the clicked
  // chart, `figure`, is scrolled into view.
  function choose(id, seconds, figure) {
    const sky = skies[id];
    sky.chosen = seconds;
    sky.slider.value = sky.nearest(seconds);
    for (const other of Object.values(skies)) if (other !== sky) { other.figure.classList.remove("docked"); other.chosen = null; }
    sky.figure.classList.add("docked");
    sky.draw();
    requestAnimationFrame(() => { mark(id); setTimeout(() => makeRoom(figure), 100); });
  }
  function makeRoom(figure) {
    document.body.classList.toggle("with-panel", Object.values(skies).some(sky => sky.figure.classList.contains("docked")));
    if (figure) figure.scrollIntoView({ block: "nearest", behavior: "instant" });
  }
  function mark(id) {
    for (const plot of plots)
      if (plot.chart && plot.figure.dataset.drawn && plot.figure.dataset.sky === id && inSight(plot.figure)) Plotly.relayout(plot.div, { shapes: plot.chosenShapes() });
  }

  // ---- charts are drawn when they are near the visible part of the page, and all charts before printing
  function timing(name) { document.getElementById("railfix-timing").dataset[name] = performance.now().toFixed(0); }
  document.querySelectorAll("figure[data-chart]").forEach(function (figure) {
    const plot = figure.classList.contains("skyplot") ? new Sky(figure) : new Plot(figure);
    figure.plot = plot;
    if (plot instanceof Plot) plots.push(plot);
  });
  document.querySelectorAll(".with-sky").forEach(part => { part.hidden = !Object.keys(skies).length; });
  const everything = () => [...plots, ...Object.values(skies)];
  function inSight(figure) {
    const place = figure.getBoundingClientRect();
    return place.width > 0 && place.top < window.innerHeight + 300 && place.bottom > -300; // no width: folded
  }
  function near() {
    for (const plot of everything()) if (!plot.figure.dataset.drawn && inSight(plot.figure)) {
      plot.draw();
      timing("drawn");
    }
  }
  near();
  let waiting = false;
  window.addEventListener("scroll", function () {
    if (waiting) return;
    waiting = true;
    setTimeout(function () { waiting = false; near(); }, 60);
  }, { passive: true });
  window.addEventListener("load", function () { // the data of the sky plots are decoded before the first click
    timing("load");
    setTimeout(() => Object.values(skies).forEach(sky => sky.load()), 500);
  });
  window.addEventListener("resize", near);
  function again() { for (const plot of everything()) if (printing || plot.figure.dataset.drawn) plot.draw(); }
  darkness.addEventListener("change", again);
  document.querySelectorAll("details").forEach(part => part.addEventListener("toggle", near));
  window.addEventListener("beforeprint", function () {
    printing = true;
    document.querySelectorAll("details").forEach(function (part) { part.dataset.was = part.open; part.open = true; });
    again();
  });
  window.addEventListener("afterprint", function () {
    printing = false;
    document.querySelectorAll("details").forEach(function (part) { part.open = part.dataset.was === "true"; });
    again();
  });

  // ---- links of findings in a network move the plan to the finding
  document.querySelectorAll('a[href^="#plan:"]').forEach(link => link.addEventListener("click", function (event) {
    const [x, y] = link.getAttribute("href").slice(6).split(",").map(Number), plot = plots.find(one => one.load().equal);
    event.preventDefault();
    plot.draw();
    plot.figure.scrollIntoView({ block: "nearest" });
    Plotly.relayout(plot.div, { "xaxis.range": [x - 150, x + 150], "yaxis.range": [y - 75, y + 75], shapes: [{ type: "circle", xsizemode: "pixel",
      ysizemode: "pixel", xanchor: x, yanchor: y, x0: -12, x1: 12, y0: -12, y1: 12, line: { color: tone("#d55e00"), width: 2 } }] });
  }));

  // ---- tables as CSV files
  function csv(table) {
    const cell = c => {
      let text = c.textContent.trim();
      if (c.classList.contains("n")) text = text.replace(/\u2212/g, "-").replace(/(\d),(?=\d{3})/g, "$1").replace(/^\u2013$/, "");
      return /[",\n]/.test(text) ? '"' + text.replace(/"/g, '""') + '"' : text;
    };
    return [...table.rows].map(row => [...row.cells].map(cell).join(",")).join("\r\n") + "\r\n";
  }
  document.querySelectorAll("button.download").forEach(function (button) {
    button.hidden = false;
    button.addEventListener("click", function () {
      const table = button.parentNode.querySelector("table"), link = document.createElement("a");
      link.href = URL.createObjectURL(new Blob([csv(table)], { type: "text/csv" }));
      link.download = table.dataset.name + ".csv";
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    });
  });
})();
