// Charts of the page: axes, layers, tips, shared zoom, sky plots, light and dark; tables as CSV files. No libraries.
"use strict";
(function () {
  const FONT = "12px system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', Arial, sans-serif";
  const LIGHT = { ink: "#1b1b1b", grid: "#e3e3e3", axis: "#767676", paper: "#ffffff", halo: "#ffffffd9" };
  const DARK = { ink: "#e8e8e8", grid: "#343a41", axis: "#8d959e", paper: "#14181c", halo: "#14181cd9" };
  const darkness = window.matchMedia("(prefers-color-scheme: dark)");
  const isDark = () => darkness.matches && !printing;
  const theme = () => isDark() ? DARK : LIGHT;
  const PRINT_WIDTH = { wide: 760, half: 420, sky: 360 };
  const plots = [], skies = {}, zoomed = {};
  let printing = false;

  // Colour of a layer: lighter on a dark page.
  function tone(colour) {
    if (!isDark()) return colour;
    if (colour === "#000000") return DARK.ink;
    return "#" + [1, 3, 5].map(i => Math.round(parseInt(colour.slice(i, i + 2), 16) * 0.6 + 255 * 0.4).toString(16).padStart(2, "0")).join("");
  }

  // ---- numbers: float32 or whole numbers, little endian, base 64
  function bytes(text) {
    const raw = atob(text), out = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
    return out.buffer;
  }
  function numbers(packed) {
    if (packed === undefined || packed === null) return null;
    const kinds = { f: Float32Array, h: Uint16Array, i: Uint32Array };
    return new kinds[packed[0]](bytes(packed.slice(1)));
  }
  function unpack(chart) {
    for (const layer of chart.layers)
      for (const key of ["x", "y", "low", "mid", "high", "left", "right", "height", "epoch", "a", "b", "n"])
        if (typeof layer[key] === "string") layer[key] = numbers(layer[key]);
    return chart;
  }

  // ---- scales and ticks
  function scale(kind, linear) {
    if (kind === "log") return { to: v => v > 0 ? Math.log10(v) : NaN, from: v => Math.pow(10, v) };
    if (kind === "symlog") return {
      to: v => Math.abs(v) <= linear ? v / linear : Math.sign(v) * (1 + Math.log10(Math.abs(v) / linear)),
      from: v => Math.abs(v) <= 1 ? v * linear : Math.sign(v) * linear * Math.pow(10, Math.abs(v) - 1) };
    return { to: v => v, from: v => v };
  }
  const TIME_STEPS = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800,
    3600, 7200, 10800, 21600, 43200, 86400, 172800, 604800];
  function nice(rough) {
    const power = Math.pow(10, Math.floor(Math.log10(rough)));
    for (const k of [1, 2, 5, 10]) if (power * k >= rough * 0.999999) return power * k;
    return power * 10;
  }
  function steps(low, high, step, offset) {
    const out = [];
    for (let k = Math.ceil((low + offset) / step - 1e-9); k * step - offset <= high + step * 1e-9 && out.length < 60; k++)
      out.push(k * step - offset);
    return out;
  }
  function digits(step) { return Math.max(0, Math.min(9, -Math.floor(Math.log10(step) + 1e-9))); }
  function ticks(axis, many) {
    const low = axis.low, high = axis.high, span = Math.max(high - low, 1e-12);
    if (axis.start !== undefined) {
      const step = TIME_STEPS.find(s => span / s <= many) || TIME_STEPS[TIME_STEPS.length - 1];
      return steps(low, high, step, axis.start % 86400).map(v => [v, clock(axis.start + v, step < 1 ? digits(step) : 0)]);
    }
    if (axis.kind === "linear") {
      const step = nice(span / many), n = digits(step);
      return steps(low, high, step, 0).map(v => [v, plain(v, n)]);
    }
    const out = axis.kind === "symlog" ? [0] : [];
    if (axis.kind === "symlog") for (const v of [axis.linear / 2, axis.linear]) out.push(v, -v);
    const first = axis.kind === "symlog" ? Math.floor(Math.log10(axis.linear)) + 1 : Math.ceil(Math.log10(low));
    for (let k = first; Math.pow(10, k) <= Math.max(Math.abs(low), Math.abs(high)) * 1.0001 && k < first + 12; k++) {
      if (Math.pow(10, k) < 1.5 * axis.linear && axis.kind === "symlog") continue;
      out.push(Math.pow(10, k));
      if (axis.kind === "symlog") out.push(-Math.pow(10, k));
    }
    return out.filter(v => v >= low && v <= high).map(v => [v, plain(v, Math.abs(v) < 1 && v !== 0 ? 2 : 0)]);
  }
  function plain(value, n) {
    const text = value.toFixed(n);
    return text.replace(/\B(?=(\d{3})+(?!\d))/g, n > 3 ? "" : ",").replace("-", "\u2212");
  }
  function clock(seconds, n) {
    const day = ((seconds % 86400) + 86400) % 86400, whole = Math.floor(day + 0.5 * Math.pow(10, -n) * (n ? 1 : 0) + 1e-6);
    const two = v => String(v).padStart(2, "0");
    const part = n ? (day - Math.floor(day)).toFixed(n).slice(1) : "";
    return two(Math.floor(whole / 3600) % 24) + ":" + two(Math.floor(whole / 60) % 60) + ":" + two(whole % 60) + part;
  }
  function date(seconds) { return new Date(seconds * 1000).toISOString().slice(0, 10); }
  function short(value) {
    if (!isFinite(value)) return "unknown";
    const size = Math.abs(value);
    return plain(value, size >= 1000 ? 1 : size >= 1 ? 2 : 3);
  }

  // ---- what a layer spans
  function spans(layer) {
    switch (layer.kind) {
      case "points": case "line": case "marks": return [[layer.x], [layer.y]];
      case "band": return [[layer.x], [layer.low, layer.high]];
      case "bars": return [[layer.left, layer.right], [layer.height]];
      case "cells": return [[[layer.x0, layer.x1]], [[layer.y0, layer.y1]]];
      default: return [[layer.low, layer.high], [[-0.5, layer.names.length - 0.5]]];
    }
  }
  function extent(arrays) {
    let low = Infinity, high = -Infinity;
    for (const array of arrays) for (let i = 0; i < array.length; i++) {
      const v = array[i];
      if (v < low && v > -Infinity) low = v;
      if (v > high && v < Infinity) high = v;
    }
    return low <= high ? [low, high] : null;
  }

  // ---- one chart
  function Plot(figure) {
    this.figure = figure;
    this.canvas = figure.querySelector("canvas");
    this.tip = figure.querySelector(".tip");
    this.hidden = new Set();
    this.view = null;
  }
  Plot.prototype.load = function () {
    if (!this.chart) {
      this.chart = unpack(JSON.parse(document.getElementById(this.figure.dataset.chart).textContent));
      this.full = this.bounds();
      const x = zoomed[this.figure.dataset.zoom];
      if (x) this.view = { x: x.map(v => v - (this.chart.start || 0)), y: this.full.y };
      this.legend();
      this.listen();
    }
    return this.chart;
  };
  Plot.prototype.bounds = function () {
    const chart = this.chart, out = [];
    for (const i of [0, 1]) {
      const given = i ? chart.y_range : chart.x_range, kind = i ? chart.y_scale : chart.x_scale;
      let found = given || extent(chart.layers.flatMap(layer => spans(layer)[i])) || [0, 1];
      const names = chart.layers.some(layer => layer.kind === "ranges");
      if (!given && !(names && i)) {
        const to = scale(kind, chart.y_linear);
        if (kind === "log") found = [Math.max(0.8, found[0] > 0 ? found[0] * 0.8 : 0.8), Math.max(found[1] * 1.3, 10)];
        else {
          let [a, b] = found.map(to.to), pad = (b - a) * (i ? 0.06 : 0.015) || Math.max(Math.abs(a) * 0.1, 0.5);
          if (chart.layers.some(layer => layer.kind === "bars") && i === 0) pad = 0;
          found = [to.from(a - pad), to.from(b + pad)];
        }
      }
      out.push(found);
    }
    return { x: out[0], y: out[1] };
  };
  Plot.prototype.legend = function () {
    const box = this.figure.querySelector(".legend"), self = this, seen = new Set();
    box.textContent = "";
    for (const layer of this.chart.layers) {
      if (!layer.label || seen.has(layer.label)) continue;
      seen.add(layer.label);
      const button = document.createElement("button"), sample = document.createElement("i");
      const colour = tone(layer.colour);
      sample.style.background = layer.kind === "line" ? `linear-gradient(${colour},${colour}) center/100% 3px no-repeat` :
        layer.kind === "band" || layer.kind === "bars" ? colour + "66" : colour;
      const glyph = layer.kind === "marks" ? "+" : layer.shape === "cross" ? "\u00d7" : "";
      if (glyph) {
        sample.style.cssText = `background:none;width:auto;height:auto;font-style:normal;font-weight:700;color:${colour}`;
        sample.textContent = glyph;
      } else if (layer.kind === "points") sample.style.cssText += layer.shape === "dot" ?
        `;width:.7rem;border-radius:50%` : `;width:.7rem;background:none;border:2px solid ${colour}`;
      button.type = "button";
      button.setAttribute("aria-pressed", String(!this.hidden.has(layer.label)));
      button.append(sample, layer.label);
      button.addEventListener("click", function () {
        const off = !self.hidden.has(layer.label);
        self.hidden[off ? "add" : "delete"](layer.label);
        button.setAttribute("aria-pressed", String(!off));
        self.draw();
      });
      box.append(button);
    }
    this.back = document.createElement("button");
    this.back.type = "button";
    this.back.className = "whole";
    this.back.textContent = "show all again";
    this.back.hidden = !this.view;
    this.back.addEventListener("click", function () { self.zoom(null); });
    box.append(this.back);
  };
  // Charts with the same x axis follow; positions on an axis of time are compared in absolute time.
  Plot.prototype.zoom = function (view) {
    this.show(view);
    const group = this.figure.dataset.zoom, origin = this.chart.start || 0;
    if (!group) return;
    zoomed[group] = view && view.x.map(v => v + origin);
    for (const plot of plots) if (plot !== this && plot.figure.dataset.zoom === group && plot.figure.dataset.drawn) plot.follow();
  };
  Plot.prototype.follow = function () {
    const x = zoomed[this.figure.dataset.zoom], origin = this.chart.start || 0;
    this.show(x ? { x: x.map(v => v - origin), y: this.full.y } : null);
  };
  Plot.prototype.show = function (view) { this.view = view; this.back.hidden = !view; this.draw(); };
  Plot.prototype.shown = function () { return this.chart.layers.filter(layer => !this.hidden.has(layer.label)); };

  Plot.prototype.frame = function () {
    const chart = this.chart, half = this.figure.classList.contains("half");
    const width = printing ? PRINT_WIDTH[half ? "half" : "wide"] : Math.max(260, this.canvas.parentNode.clientWidth);
    const names = chart.layers.find(layer => layer.kind === "ranges");
    let height = half ? 300 : 320;
    if (chart.equal && !half) height = Math.min(520, Math.max(300, Math.round(width * 0.5)));
    if (!printing && this.figure.closest(".overview")) height = window.innerWidth > 760 ? 350 : 280;
    if (names) height = 70 + 26 * names.names.length;
    const pen = canvasPen(this.canvas, width, height);
    const box = { left: 66, right: width - 14, top: 10, bottom: height - 42, width, height };
    if (names) {
      const widest = Math.max.apply(null, names.names.map(name => pen.measureText(name).width));
      box.left = Math.min(widest + 16, width * 0.45);
    }
    const view = this.view || this.full;
    const fx = scale(chart.x_scale, chart.y_linear), fy = scale(chart.y_scale, chart.y_linear);
    let [x0, x1] = view.x.map(fx.to), [y0, y1] = view.y.map(fy.to);
    if (names) [y0, y1] = [y1, y0];
    if (chart.equal) {
      const per = Math.max((x1 - x0) / (box.right - box.left), (y1 - y0) / (box.bottom - box.top));
      const cx = (x0 + x1) / 2, cy = (y0 + y1) / 2;
      [x0, x1] = [cx - per * (box.right - box.left) / 2, cx + per * (box.right - box.left) / 2];
      [y0, y1] = [cy - per * (box.bottom - box.top) / 2, cy + per * (box.bottom - box.top) / 2];
      box.perPixel = per;
    }
    const kx = (box.right - box.left) / (x1 - x0), ky = (box.bottom - box.top) / (y1 - y0);
    box.px = v => box.left + (fx.to(v) - x0) * kx;
    box.py = v => box.bottom - (fy.to(v) - y0) * ky;
    box.vx = p => fx.from(x0 + (p - box.left) / kx);
    box.vy = p => fy.from(y0 + (box.bottom - p) / ky);
    box.x = [fx.from(x0), fx.from(x1)];
    box.y = [fy.from(Math.min(y0, y1)), fy.from(Math.max(y0, y1))];
    return [pen, box];
  };

  function canvasPen(canvas, width, height) {
    const ratio = printing ? 2 : Math.max(2, Math.min(3, window.devicePixelRatio || 1));
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    canvas.style.height = height + "px";
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.font = FONT;
    pen.fillStyle = theme().paper;
    pen.fillRect(0, 0, width, height);
    return pen;
  }

  // Many points on paper: all of a chart as one picture, which is smaller than thousands of outlines.
  function raster(box) {
    const picture = document.createElement("canvas");
    picture.width = Math.round(box.width);
    picture.height = Math.round(box.height);
    return picture.getContext("2d");
  }
  Plot.prototype.draw = function () {
    const chart = this.load(), [pen, box] = this.frame();
    this.box = box;
    this.axes(pen, box);
    pen.save();
    pen.beginPath();
    pen.rect(box.left, box.top, box.right - box.left, box.bottom - box.top);
    pen.clip();
    const dots = printing && raster(box);
    let marks = 0;
    for (const layer of this.shown()) marks += LAYERS[layer.kind](dots && layer.kind === "points" ? dots : pen, box, layer);
    if (dots) pen.drawImage(dots.canvas, 0, 0, box.width, box.height);
    pen.restore();
    if (chart.equal) compass(pen, box);
    pen.strokeStyle = theme().axis;
    pen.lineWidth = 1;
    pen.strokeRect(box.left + 0.5, box.top + 0.5, box.right - box.left - 1, box.bottom - box.top - 1);
    this.figure.dataset.drawn = marks;
  };

  Plot.prototype.axes = function (pen, box) {
    const chart = this.chart, names = chart.layers.find(layer => layer.kind === "ranges");
    const xs = ticks({ kind: chart.x_scale, low: box.x[0], high: box.x[1], linear: chart.y_linear, start: chart.start },
      Math.max(3, Math.floor((box.right - box.left) / (chart.start === undefined ? 75 : 90))));
    const ys = names ? [] : ticks({ kind: chart.y_scale, low: box.y[0], high: box.y[1], linear: chart.y_linear },
      Math.max(3, Math.floor((box.bottom - box.top) / 38)));
    pen.strokeStyle = theme().grid;
    pen.lineWidth = 1;
    pen.beginPath();
    for (const [v] of xs) { const p = Math.round(box.px(v)) + 0.5; pen.moveTo(p, box.top); pen.lineTo(p, box.bottom); }
    for (const [v] of ys) { const p = Math.round(box.py(v)) + 0.5; pen.moveTo(box.left, p); pen.lineTo(box.right, p); }
    pen.stroke();
    pen.fillStyle = theme().ink;
    pen.textAlign = "center";
    pen.textBaseline = "top";
    for (const [v, text] of xs) {
      const half = pen.measureText(text).width / 2;
      pen.fillText(text, Math.min(box.px(v), box.width - half - 1), box.bottom + 5);
    }
    pen.fillText(chart.start === undefined ? chart.x_label : chart.x_label + ", " + date(chart.start + box.x[0]),
      (box.left + box.right) / 2, box.bottom + 23);
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    let last = Infinity;
    for (const [v, text] of ys.sort((a, b) => a[0] - b[0])) {
      if (last - box.py(v) < 13) continue;
      last = box.py(v);
      pen.fillText(text, box.left - 6, last);
    }
    if (names) names.names.forEach((name, i) => pen.fillText(fit(pen, name, box.left - 14), box.left - 8, box.py(i)));
    pen.save();
    pen.translate(13, (box.top + box.bottom) / 2);
    pen.rotate(-Math.PI / 2);
    pen.textAlign = "center";
    pen.fillText(fit(pen, chart.y_label, box.bottom - box.top + 30), 0, 0);
    pen.restore();
  };
  function fit(pen, text, width) {
    if (pen.measureText(text).width <= width) return text;
    while (text.length > 3 && pen.measureText(text + "\u2026").width > width) text = text.slice(0, -1);
    return text + "\u2026";
  }
  function compass(pen, box) {
    const x = box.right - 22, y = box.top + 40, length = nice(120 * box.perPixel) / box.perPixel;
    pen.strokeStyle = pen.fillStyle = theme().ink;
    pen.lineWidth = 1.5;
    pen.beginPath();
    pen.moveTo(x, y); pen.lineTo(x, y - 22);
    pen.moveTo(x - 5, y - 14); pen.lineTo(x, y - 23); pen.lineTo(x + 5, y - 14);
    const end = box.right - 16, low = box.bottom - 14;
    pen.moveTo(end - length, low - 5); pen.lineTo(end - length, low); pen.lineTo(end, low); pen.lineTo(end, low - 5);
    pen.stroke();
    pen.textAlign = "center";
    pen.textBaseline = "bottom";
    pen.fillText("N", x, y + 14);
    const metres = length * box.perPixel;
    pen.fillText(metres >= 1000 ? metres / 1000 + " km" : Number(metres.toPrecision(1)) + " m", end - length / 2, low - 4);
  }

  // ---- layers; each returns how many things it drew
  function path(pen, box, x, y, back) {
    let on = false, n = 0;
    for (let i = 0; i < x.length; i++) {
      if (x[i] !== x[i] || y[i] !== y[i]) { on = false; continue; }
      pen[on ? "lineTo" : "moveTo"](box.px(x[i]), box.py(y[i]));
      on = true;
      n++;
    }
    return n;
  }
  const LAYERS = {
    points(pen, box, layer) {
      const r = layer.size / 2;
      let n = 0;
      pen.beginPath();
      for (let i = 0; i < layer.x.length; i++) {
        const x = box.px(layer.x[i]), y = box.py(layer.y[i]);
        if (!(x > box.left - 9 && x < box.right + 9 && y > box.top - 9 && y < box.bottom + 9)) continue;
        n++;
        if (layer.shape === "square") pen.rect(x - r, y - r, layer.size, layer.size);
        else if (layer.shape === "cross") {
          pen.moveTo(x - r, y - r); pen.lineTo(x + r, y + r);
          pen.moveTo(x - r, y + r); pen.lineTo(x + r, y - r);
        } else { pen.moveTo(x + r, y); pen.arc(x, y, r, 0, 6.2832); }
      }
      pen.fillStyle = pen.strokeStyle = tone(layer.colour);
      pen.lineWidth = 1;
      if (layer.shape === "dot") pen.fill(); else pen.stroke();
      return n;
    },
    line(pen, box, layer) {
      pen.beginPath();
      const n = path(pen, box, layer.x, layer.y);
      pen.strokeStyle = tone(layer.colour);
      pen.lineWidth = layer.width;
      pen.lineJoin = "round";
      pen.setLineDash({ solid: [], dashed: [6, 4], dotted: [2, 3] }[layer.dash]);
      pen.stroke();
      pen.setLineDash([]);
      return n;
    },
    band(pen, box, layer) {
      let n = 0;
      pen.fillStyle = tone(layer.colour) + "40";
      for (let i = 0; i < layer.x.length;) {
        while (i < layer.x.length && layer.x[i] !== layer.x[i]) i++;
        let j = i;
        while (j < layer.x.length && layer.x[j] === layer.x[j] && layer.low[j] === layer.low[j]) j++;
        if (j === i) { i++; continue; }
        pen.beginPath();
        for (let k = i; k < j; k++) pen.lineTo(box.px(layer.x[k]), box.py(layer.high[k]));
        for (let k = j - 1; k >= i; k--) pen.lineTo(box.px(layer.x[k]), box.py(layer.low[k]));
        pen.fill();
        n += j - i;
        i = j;
      }
      return n;
    },
    bars(pen, box, layer) {
      let n = 0;
      pen.fillStyle = tone(layer.colour) + "88";
      pen.strokeStyle = tone(layer.colour);
      pen.lineWidth = 1;
      for (let i = 0; i < layer.height.length; i++) {
        if (!(layer.height[i] > 0)) continue;
        const x = box.px(layer.left[i]), y = box.py(layer.height[i]), wide = box.px(layer.right[i]) - x;
        pen.fillRect(x, y, wide, box.bottom - y);
        pen.strokeRect(x + 0.5, y + 0.5, Math.max(wide - 1, 0.5), box.bottom - y);
        n++;
      }
      return n;
    },
    cells(pen, box, layer) {
      const most = Math.log(1 + layer.most), wide = (layer.x1 - layer.x0) / layer.nx, high = (layer.y1 - layer.y0) / layer.ny;
      for (let i = 0; i < layer.n.length; i++) {
        const share = Math.log(1 + layer.n[i]) / most, grey = Math.round(isDark() ? 60 + 180 * share : 215 - 195 * share);
        const x = box.px(layer.x0 + layer.a[i] * wide), y = box.py(layer.y0 + (layer.b[i] + 1) * high);
        pen.fillStyle = "rgb(" + grey + "," + grey + "," + grey + ")";
        pen.fillRect(x, y, box.px(layer.x0 + (layer.a[i] + 1) * wide) - x + 0.4, box.py(layer.y0 + layer.b[i] * high) - y + 0.4);
      }
      return layer.n.length;
    },
    ranges(pen, box, layer) {
      let n = 0;
      for (let i = 0; i < layer.names.length; i++) {
        if (layer.mid[i] !== layer.mid[i]) continue;
        const a = box.px(layer.low[i]), b = box.px(layer.high[i]), m = box.px(layer.mid[i]), y = box.py(i);
        pen.fillStyle = tone(layer.colour) + "70";
        pen.fillRect(a, y - 6, Math.max(b - a, 1), 12);
        pen.fillStyle = tone(layer.colour);
        pen.fillRect(m - 1.5, y - 9, 3, 18);
        n++;
      }
      return n;
    },
    marks(pen, box, layer) {
      if (layer.place === "on") return wordsOn(pen, box, layer);
      pen.strokeStyle = pen.fillStyle = tone(layer.colour);
      pen.lineWidth = 1.5;
      pen.textAlign = "left";
      pen.textBaseline = "bottom";
      for (let i = 0; i < layer.x.length; i++) {
        const x = box.px(layer.x[i]), y = box.py(layer.y[i]);
        pen.beginPath();
        pen.moveTo(x - 4, y); pen.lineTo(x + 4, y); pen.moveTo(x, y - 4); pen.lineTo(x, y + 4);
        pen.stroke();
        pen.lineWidth = 3;
        pen.strokeStyle = theme().halo;
        pen.strokeText(layer.words[i], x + 5, y - 3);
        pen.strokeStyle = tone(layer.colour);
        pen.lineWidth = 1.5;
        pen.fillText(layer.words[i], x + 5, y - 3);
      }
      return layer.x.length;
    }
  };

  function wordsOn(pen, box, layer) {
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.lineJoin = "round";
    pen.fillStyle = tone(layer.colour);
    pen.strokeStyle = theme().halo;
    pen.lineWidth = 4;
    for (let i = 0; i < layer.x.length; i++) {
      const lines = layer.words[i].split("\n"), x = box.px(layer.x[i]), y = box.py(layer.y[i]);
      lines.forEach((line, k) => {
        const down = y + 14 * (k - (lines.length - 1) / 2);
        pen.strokeText(line, x, down);
        pen.fillText(line, x, down);
      });
    }
    return layer.x.length;
  }

  // ---- tips, zoom, choice of an epoch
  Plot.prototype.near = function (x, y) {
    let best = null, least = 18 * 18;
    for (const layer of this.shown()) {
      if (layer.kind !== "points" && !(layer.kind === "line" && layer.x.length > 2)) continue;
      for (let i = 0; i < layer.x.length; i++) {
        const dx = this.box.px(layer.x[i]) - x, dy = this.box.py(layer.y[i]) - y, away = dx * dx + dy * dy;
        if (away < least) { least = away; best = [layer, i]; }
      }
    }
    return best;
  };
  Plot.prototype.tipText = function (x, y) {
    const chart = this.chart, box = this.box, at = v => chart.start === undefined ? short(v) : clock(chart.start + v, 1);
    const hit = this.near(x, y);
    if (hit) {
      const [layer, i] = hit;
      return (layer.label || chart.title) + "\n" + chart.x_label + " " + at(layer.x[i]) + "\n" + chart.y_label + " " + short(layer.y[i]);
    }
    const vx = box.vx(x), vy = box.vy(y);
    for (const layer of this.shown()) {
      if (layer.kind === "ranges") {
        const i = Math.round(vy);
        if (i >= 0 && i < layer.names.length && layer.mid[i] === layer.mid[i]) return layer.names[i] + "\nlowest " +
          short(layer.low[i]) + "\nmean " + short(layer.mid[i]) + "\nhighest " + short(layer.high[i]);
      } else if (layer.kind === "bars") {
        for (let i = 0; i < layer.left.length; i++) if (vx >= layer.left[i] && vx < layer.right[i] && layer.height[i] >= vy)
          return layer.label + "\n" + short(layer.left[i]) + " to " + short(layer.right[i]) + ": " + plain(layer.height[i], 0);
      } else if (layer.kind === "cells") {
        const a = Math.floor((vx - layer.x0) / (layer.x1 - layer.x0) * layer.nx), b = Math.floor((vy - layer.y0) / (layer.y1 - layer.y0) * layer.ny);
        for (let i = 0; i < layer.n.length; i++) if (layer.a[i] === a && layer.b[i] === b)
          return plain(layer.n[i], 0) + " " + layer.label + "\n" + chart.x_label + " " + short(vx) + "\n" + chart.y_label + " " + short(vy);
      }
    }
    return "";
  };
  Plot.prototype.listen = function () {
    const self = this, canvas = this.canvas;
    let from = null;
    const at = event => { const r = canvas.getBoundingClientRect(); return [event.clientX - r.left, event.clientY - r.top]; };
    canvas.addEventListener("pointerdown", function (event) {
      if (event.pointerType === "mouse" && event.button === 0) { from = at(event); if (event.isTrusted) canvas.setPointerCapture(event.pointerId); }
    });
    canvas.addEventListener("pointermove", function (event) {
      const [x, y] = at(event);
      if (from && Math.hypot(x - from[0], y - from[1]) > 5) {
        self.tip.hidden = true;
        self.draw();
        const pen = canvas.getContext("2d");
        pen.fillStyle = "#0072b22e";
        pen.fillRect(from[0], from[1], x - from[0], y - from[1]);
        return;
      }
      const text = self.tipText(x, y);
      self.tip.hidden = !text;
      self.tip.textContent = text;
      const right = x > self.box.width * 0.6;
      self.tip.style.left = right ? "auto" : (x + 14) + "px";
      self.tip.style.right = right ? (self.box.width - x + 14) + "px" : "auto";
      self.tip.style.top = Math.max(0, y - 10) + "px";
    });
    canvas.addEventListener("pointerleave", function () { self.tip.hidden = true; });
    canvas.addEventListener("pointerup", function (event) {
      const [x, y] = at(event), start = from;
      from = null;
      if (start && Math.abs(x - start[0]) > 5 && Math.abs(y - start[1]) > 5) {
        const xs = [self.box.vx(start[0]), self.box.vx(x)].sort((a, b) => a - b);
        const ys = [self.box.vy(start[1]), self.box.vy(y)].sort((a, b) => a - b);
        self.zoom({ x: xs, y: ys });
      } else {
        if (start) self.draw();
        const hit = self.near(x, y);
        if (hit && hit[0].epoch && self.figure.dataset.sky) show(self.figure.dataset.sky, hit[0].epoch[hit[1]] + (self.chart.epoch0 || 0));
      }
    });
    canvas.addEventListener("dblclick", function () { self.zoom(null); });
    canvas.addEventListener("keydown", function (event) {
      const factor = { "+": 0.5, "=": 0.5, "-": 2 }[event.key], step = { ArrowLeft: -0.2, ArrowRight: 0.2 }[event.key];
      if (!factor && !step && event.key !== "0") return;
      event.preventDefault();
      if (event.key === "0") return self.zoom(null);
      const middle = (self.box.left + self.box.right) / 2, half = (self.box.right - self.box.left) / 2 * (factor || 1);
      const shift = (step || 0) * 2 * half;
      self.zoom({ x: [self.box.vx(middle + shift - half), self.box.vx(middle + shift + half)], y: self.box.y });
    });
  };

  // ---- the sky
  function Sky(figure) {
    this.figure = figure;
    this.canvas = figure.querySelector("canvas");
    this.slider = figure.querySelector("input");
    this.time = figure.querySelector("output");
    this.rows = figure.querySelector("tbody");
    skies[figure.id] = this;
  }
  Sky.prototype.load = function () {
    if (this.data) return;
    this.data = JSON.parse(document.getElementById(this.figure.dataset.chart).textContent);
    for (const key of ["epoch", "first", "satellite", "signal", "azimuth", "elevation", "cn0", "reason"])
      this.data[key] = numbers(this.data[key]);
    this.slider.max = this.data.epoch.length - 1;
    this.slider.addEventListener("input", () => this.draw());
  };
  Sky.prototype.draw = function () {
    this.load();
    const data = this.data, k = Number(this.slider.value);
    const width = printing ? PRINT_WIDTH.sky : Math.max(240, Math.min(430, this.canvas.parentNode.clientWidth));
    const pen = canvasPen(this.canvas, width, width), c = width / 2, r = c - 26;
    this.time.textContent = date(data.start + data.epoch[k]) + " " + clock(data.start + data.epoch[k], 1);
    grid(pen, c, r);
    this.rows.textContent = "";
    const order = [], taken = [];
    for (let i = data.first[k]; i < data.first[k + 1]; i++) order.push(i);
    order.sort((a, b) => (data.reason[a] === 0 ? 0 : 1) - (data.reason[b] === 0 ? 0 : 1) || data.satellite[a] - data.satellite[b]);
    for (const i of order) {
      const azimuth = data.azimuth[i] / 100, elevation = data.elevation[i] / 100, cn0 = data.cn0[i] === 65535 ? NaN : data.cn0[i] / 100;
      const used = data.reason[i] === 0, turn = azimuth * Math.PI / 180, out = r * (90 - elevation) / 90;
      const x = c + out * Math.sin(turn), y = c - out * Math.cos(turn);
      pen.strokeStyle = pen.fillStyle = tone(used ? "#0072b2" : "#d55e00");
      pen.lineWidth = 2;
      pen.beginPath();
      if (used) { pen.arc(x, y, 5, 0, 6.2832); pen.fill(); }
      else { pen.moveTo(x - 4, y - 4); pen.lineTo(x + 4, y + 4); pen.moveTo(x - 4, y + 4); pen.lineTo(x + 4, y - 4); pen.stroke(); }
      label(pen, data.names[data.satellite[i]] + (cn0 === cn0 ? " " + cn0.toFixed(0) : ""), x, y, width, taken);
      const row = document.createElement("tr");
      for (const [text, right] of [[data.names[data.satellite[i]]], [data.signals[data.signal[i]]], [elevation.toFixed(0), 1],
        [azimuth.toFixed(0), 1], [cn0 === cn0 ? cn0.toFixed(1) : "", 1], [data.reasons[data.reason[i]]]]) {
        const cell = document.createElement("td");
        cell.textContent = text;
        if (right) cell.className = "n";
        row.append(cell);
      }
      this.rows.append(row);
    }
    this.figure.dataset.drawn = order.length;
  };
  // A name beside its satellite, where no other name stands if there is such a place.
  function label(pen, text, x, y, width, taken) {
    const wide = pen.measureText(text).width;
    const places = [[x + 8, y], [x - 8 - wide, y], [x - wide / 2, y - 13], [x - wide / 2, y + 13]].filter(
      p => p[0] > 0 && p[0] + wide < width);
    const free = p => taken.every(t => p[0] > t[1] || p[0] + wide < t[0] || Math.abs(p[1] - t[2]) > 12);
    const place = places.find(free) || places[0] || [x + 8, y];
    taken.push([place[0], place[0] + wide, place[1]]);
    pen.fillStyle = theme().ink;
    pen.textAlign = "left";
    pen.textBaseline = "middle";
    pen.fillText(text, place[0], place[1]);
  }
  function grid(pen, c, r) {
    pen.strokeStyle = theme().axis;
    pen.fillStyle = theme().ink;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    for (const elevation of [0, 30, 60]) {
      pen.lineWidth = elevation ? 0.6 : 1.2;
      pen.beginPath();
      pen.arc(c, c, r * (90 - elevation) / 90, 0, 6.2832);
      pen.stroke();
      if (elevation) pen.fillText(elevation + "\u00b0", c + 12, c - r * (90 - elevation) / 90 - 8);
    }
    pen.lineWidth = 0.6;
    ["N", "E", "S", "W"].forEach(function (name, i) {
      const turn = i * Math.PI / 2;
      pen.beginPath(); pen.moveTo(c, c); pen.lineTo(c + r * Math.sin(turn), c - r * Math.cos(turn)); pen.stroke();
      pen.fillText(name, c + (r + 14) * Math.sin(turn), c - (r + 14) * Math.cos(turn));
    });
  }
  function show(id, seconds) {
    const sky = skies[id];
    sky.load();
    const epochs = sky.data.epoch;
    let best = 0;
    for (let i = 1; i < epochs.length; i++) if (Math.abs(epochs[i] - seconds) < Math.abs(epochs[best] - seconds)) best = i;
    sky.slider.value = best;
    sky.draw();
    sky.figure.scrollIntoView({ block: "nearest" });
  }

  // ---- drawn when they come near the window, all of them for print
  function timing(name) { document.getElementById("railfix-timing").dataset[name] = performance.now().toFixed(0); }
  document.querySelectorAll("figure[data-chart]").forEach(function (figure) {
    const plot = figure.classList.contains("skyplot") ? new Sky(figure) : new Plot(figure);
    figure.plot = plot;
    plots.push(plot);
  });
  function near() {
    for (const plot of plots) {
      if (plot.figure.dataset.drawn) continue;
      const place = plot.figure.getBoundingClientRect();
      if (!place.width) continue; // folded
      if (place.top > window.innerHeight + 300 || place.bottom < -300) continue;
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
  window.addEventListener("load", () => timing("load"));
  function again() {
    for (const plot of plots) if (printing || plot.figure.dataset.drawn) {
      if (plot.chart) plot.legend();
      plot.draw();
    }
  }
  darkness.addEventListener("change", again);
  document.querySelectorAll("details").forEach(part => part.addEventListener("toggle", near));

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
  let wide = window.innerWidth, later = 0;
  window.addEventListener("resize", function () {
    near();
    if (window.innerWidth === wide || printing) return;
    wide = window.innerWidth;
    clearTimeout(later);
    later = setTimeout(function () { again(); near(); }, 150);
  });
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
})();
