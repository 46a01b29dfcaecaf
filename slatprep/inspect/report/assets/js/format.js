"use strict";
/* Elements and numbers. Text is only ever set as text, never as markup. */

/** Make an element: `el("p", {class: "hint", onclick: f}, "text", child)`. */
function el(name, attributes = {}, ...children) {
  const element = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value === undefined || value === null || value === false) continue;
    if (key.startsWith("on")) element.addEventListener(key.slice(2), value);
    else if (key === "style") for (const [k, v] of Object.entries(value)) element.style.setProperty(k, v);
    else element.setAttribute(key, value === true ? "" : value);
  }
  element.append(...children);
  return element;
}

const byId = (id) => document.getElementById(id);

const Format = (() => {
  const NONE = "–";
  const whole = new Intl.NumberFormat("en-GB");
  const superscript = (n) => String(n).replace(/[-0-9]/g, (c) => (c === "-" ? "⁻" : "⁰¹²³⁴⁵⁶⁷⁸⁹"[c]));
  const count = (n) => (n === null ? NONE : whole.format(n));
  const fixed = (digits) => (x) => (x === null ? NONE : x.toFixed(digits).replace("-", "−"));
  const share = (x, digits = 1) => {
    if (x === null) return NONE;
    const text = (100 * x).toFixed(digits);
    // Rounding must not turn a share into 0 % or 100 %.
    if (x < 1 && Number(text) === 100) return `>${(100 - 10 ** -digits).toFixed(digits)} %`;
    if (x > 0 && Number(text) === 0) return `<${(10 ** -digits).toFixed(digits)} %`;
    return `${text} %`;
  };
  /** An SI value from its mapped one: 10^7.3 as 2.0 × 10⁷. */
  const scientific = (exponent) => {
    const power = Math.floor(exponent + 1e-9);
    const plain = Number((10 ** exponent).toPrecision(3));
    if (power >= 0 && plain < 1e4) return String(plain);
    const [mantissa, rounded] = (10 ** exponent).toExponential(1).split("e");
    return `${mantissa} × 10${superscript(Number(rounded))}`;
  };
  /** Values between two ends, all with the digits that tell a hundredth of the range. */
  const within = ({ lo, hi }) => {
    const digits = Math.min(Math.max(2 - Math.floor(Math.log10(hi - lo)), 0), 20);
    const numbers = new Intl.NumberFormat("en-GB", { minimumFractionDigits: digits, maximumFractionDigits: digits });
    return (x) => numbers.format(x).replace("-", "−");
  };
  const power = (exponent) => `10${superscript(exponent)}`;
  const quantile = (values, q) => {
    if (!values.length) return null;
    const sorted = Float64Array.from(values).sort();
    const at = q * (sorted.length - 1);
    const low = Math.floor(at);
    return sorted[low] + (at - low) * ((sorted[low + 1] ?? sorted[low]) - sorted[low]);
  };
  /** Smallest and largest of many values, too many to be arguments of Math.min. */
  const extent = (values) => values.reduce(([lo, hi], x) => [Math.min(lo, x), Math.max(hi, x)], [Infinity, -Infinity]);
  const plural = (n, one, many = `${one}s`) => `${count(n)} ${n === 1 ? one : many}`;
  const annotations = (merged) => (!merged ? NONE : merged[0] === merged[1] ? count(merged[0]) : `${count(merged[0])} of ${count(merged[1])}`);
  return { NONE, annotations, count, fixed, share, scientific, within, power, quantile, extent, plural };
})();
