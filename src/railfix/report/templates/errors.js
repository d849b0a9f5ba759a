// Errors of the scripts are written into a hidden element of the page, which tests read.
"use strict";
(function () {
  const place = document.getElementById("railfix-errors");
  function note(text) { place.textContent += text + "\n"; }
  window.addEventListener("error", function (event) { note(event.message + " at " + event.lineno + ":" + event.colno); });
  window.addEventListener("unhandledrejection", function (event) { note("rejected: " + event.reason); });
  const error = console.error;
  console.error = function () { note(Array.prototype.join.call(arguments, " ")); error.apply(console, arguments); };
})();
