/* Histograms and stacked bars, made of boxes: they take the width they get, and text stays text. */

const Charts = (() => {
  /**
   * Draw a histogram.
   *
   * spec: title, sub (a line under it), edges (n + 1), bins (n lists of {colour or state, count}),
   * domain [lo, hi], marks [{at, text, own}], ticks [{at, text}], describe(k) for the reading line,
   * and choose(k), where its bars filter the table.
   */
  function histogram(spec) {
    const [lo, hi] = spec.domain;
    const place = (value) => (100 * (value - lo)) / (hi - lo);
    const totals = spec.bins.map((parts) => parts.reduce((sum, part) => sum + part.count, 0));
    const highest = Math.max(...totals, 1);
    const sub = el("p", { class: "sub" }, spec.sub);
    const read = (k) => (sub.textContent = spec.describe(k));
    const rest = () => (sub.textContent = spec.sub);
    const bars = [];
    spec.bins.forEach((parts, k) => {
      if (!totals[k]) return;
      const fill = parts
        .filter((part) => part.count)
        .map((part) =>
          el("i", {
            "data-state": part.state,
            class: part.colour && "edge",
            style: { height: `${(100 * part.count) / highest}%`, ...(part.colour && { "--tone": part.colour }) },
          }),
        );
      const left = place(spec.edges[k]);
      const attributes = {
        class: "bin",
        style: { left: `${left}%`, width: `${place(spec.edges[k + 1]) - left}%` },
        onmouseenter: () => read(k),
        onmouseleave: rest,
      };
      if (spec.choose) {
        Object.assign(attributes, {
          type: "button", tabindex: -1, "aria-pressed": "false", "aria-label": spec.describe(k),
          onclick: () => spec.choose(k), onfocus: () => read(k), onblur: rest,
        });
      }
      const bar = el(spec.choose ? "button" : "span", attributes, ...fill);
      bar.bin = k;
      bars.push(bar);
    });
    const marks = spec.marks.map((mark) =>
      el(
        "div",
        { class: `mark${mark.own ? " own" : ""}${place(mark.at) > 55 ? " end" : ""}`, style: { left: `${place(mark.at)}%` } },
        el("span", {}, mark.text),
      ),
    );
    const label = `${spec.title}. ${spec.sub}`;
    const plot = el("div", { class: "plot", role: spec.choose ? "group" : "img", "aria-label": label }, ...bars, ...marks);
    if (spec.choose) roving(plot, bars);
    const ticks = spec.ticks.map((tick) => el("span", { style: { left: `${place(tick.at)}%` } }, tick.text));
    const body = bars.length ? [plot, el("div", { class: "axis", "aria-hidden": "true" }, ...ticks)] : [el("div", { class: "empty" }, spec.empty ?? "nothing to show")];
    // Bars say nothing without a number: that of the highest, where no mark's text comes.
    const most = el("span", { "aria-hidden": "true" }, bars.length ? `highest: ${Format.count(highest)}` : "");
    const head = el("div", { class: "head" }, el("h3", {}, spec.title), most);
    const figure = el("figure", { class: "chart" }, el("figcaption", {}, head, sub), ...body);
    figure.press = (chosen) => bars.forEach((bar) => bar.setAttribute("aria-pressed", String(bar.bin === chosen)));
    return figure;
  }

  /** One stop of the Tab key for a row of bars; arrow keys go from bar to bar. */
  function roving(plot, bars) {
    if (bars.length) bars[0].tabIndex = 0;
    plot.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      const here = bars.indexOf(document.activeElement);
      const next = bars[Math.min(Math.max(here + step, 0), bars.length - 1)];
      bars.forEach((bar) => (bar.tabIndex = bar === next ? 0 : -1));
      next.focus();
    });
  }

  /** Draw rows of {label, parts: [{state or colour, share, title}], number, choose}. */
  function bars(rows) {
    return el(
      "div",
      { class: "bars" },
      ...rows.flatMap((row) => [
        row.choose
          ? el("button", { type: "button", class: "link", onclick: row.choose }, row.label)
          : el("span", {}, row.label),
        el(
          "div",
          { class: "track", role: "img", "aria-label": row.parts.map((part) => part.title).join(", ") },
          ...row.parts.map((part) =>
            el("i", {
              title: part.title,
              "data-state": part.state,
              style: { width: `${100 * part.share}%`, ...(part.colour && { "--tone": part.colour }) },
            }),
          ),
        ),
        el("span", { class: "number" }, row.number),
      ]),
    );
  }

  /** Split `values` (null left out) into equal bins of `domain`, and each bin by state. */
  function byState(values, domain, bins) {
    const [lo, hi] = domain;
    const edges = Array.from({ length: bins + 1 }, (_, k) => lo + ((hi - lo) * k) / bins);
    const counts = edges.slice(1).map(() => STATES.map((state) => ({ state: state.name, count: 0 })));
    values.forEach((value, index) => {
      if (value === null) return;
      const at = STATES.findIndex((state) => state.name === ASSETS.state[index]);
      counts[binOf(value, domain, bins)][at].count++;
    });
    return { edges, bins: counts };
  }

  const binOf = (value, [lo, hi], bins) =>
    Math.min(Math.max(Math.floor(((value - lo) / (hi - lo)) * bins), 0), bins - 1);

  return { histogram, bars, byState, binOf };
})();
