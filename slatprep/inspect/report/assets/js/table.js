/* The table of all assets: only the rows that can be seen exist. */

const Table = (() => {
  const ROW = 64;
  const SPARE = 6;
  const number = (name, digits) => ({ value: (i) => ASSETS[name][i], text: (i) => Format.fixed(digits)(ASSETS[name][i]), right: true });
  const share = (name) => ({ value: (i) => ASSETS[name][i], text: (i) => Format.share(ASSETS[name][i]), right: true });
  const COLUMNS = usable([
    { key: "picture", title: "Front, right, top", width: 142 },
    { key: "id", title: "Asset", width: 118, value: (i) => ASSETS.id[i] },
    { key: "category", title: "Category", width: 96, value: (i) => ASSETS.category[i] || null, text: (i) => ASSETS.category[i] || Format.NONE, wide: true },
    { key: "state", title: "Verdict", width: 160, value: (i) => STATES.findIndex((state) => state.name === ASSETS.state[i]) },
    { key: "model", title: "Model", width: 92, value: (i) => ASSETS.model[i], text: (i) => ASSETS.model[i] ?? Format.NONE, wide: true },
    { key: "confidence", title: "Confidence", width: 108, ...number("confidence", 3) },
    { key: "expected_accuracy", title: "Expected accuracy", width: 104, ...share("expected_accuracy"), wide: true },
    { key: "fitness", title: "Fitness", width: 84, ...number("fitness", 3), wide: true },
    { key: "fitness_backward", title: "Fitness backward", width: 104, ...number("fitness_backward", 3), wide: true },
    { key: "inlier_rmse", title: "Inlier rmse", width: 76, ...number("inlier_rmse", 3), wide: true },
    { key: "valid_share", title: "Valid share", width: 80, ...share("valid_share"), wide: true },
    { key: "ambiguity", title: "Ambiguity", width: 108, ...share("ambiguity"), wide: true },
    { key: "displacement", title: "Displaced", width: 98, ...number("displacement", 1), wide: true },
    { key: "tilt", title: "Tilt", width: 58, value: (i) => ASSETS.tilt[i], text: (i) => (ASSETS.tilt[i] === null ? Format.NONE : `${ASSETS.tilt[i].toFixed(1)}°`), right: true, wide: true },
    { key: "voxels", title: "Voxels", width: 76, value: (i) => ASSETS.voxels[i], text: (i) => Format.count(ASSETS.voxels[i]), right: true, wide: true },
    { key: "annotations", title: "Annotations", width: 118, value: (i) => ASSETS.annotations[i]?.[0] ?? null, text: (i) => Format.annotations(ASSETS.annotations[i]), right: true, wide: true, merged: true },
    { key: "votes", title: "Votes", width: 80, ...share("votes"), wide: true, merged: true },
    { key: "spread", title: "Spread", width: 94, value: Data.spread, text: (i) => Format.fixed(3)(Data.spread(i)), right: true, wide: true, merged: true },
  ]);
  const TITLES = {
    model: "Rigid, similarity, affine or deformable: what maps the PixieVerse frame to the SLAT",
    confidence: "Calibrated probability that the placement is right",
    expected_accuracy: "Share of right classes to be expected among the valid voxels",
    fitness: "Share of PixieVerse's outer boundary voxels with one of the SLAT's within the radius, before any deformation",
    fitness_backward: "Share of the SLAT's outer boundary voxels with one of PixieVerse's within the radius, before any deformation",
    inlier_rmse: "Root mean square distance of those, in voxels",
    valid_share: "Share of SLAT voxels that are valid: that found an annotation",
    ambiguity: "Share of SLAT voxels whose labels depend on the choice among tied placements",
    displacement: "Largest distance between tied placements, in voxels",
    tilt: "Angle to the nearest quarter turn",
    annotations: "Annotations of the object that its labels are merged of, and how many there are",
    votes: "Mean share of the annotations that give a voxel its class",
    spread: "Mean standard deviation over the annotations, of properties normalised to −1 to 1",
  };

  /** Leave out what only merged labels have, where there are none. */
  function usable(columns) {
    const merged = ASSETS.spreads.some((spreads) => spreads !== null);
    return columns.filter((column) => merged || !column.merged);
  }

  const box = byId("tablebox");
  const table = byId("table");
  const [head] = table.tHead ? [table.tHead] : [];
  const body = table.tBodies[0];
  const above = el("tr", { class: "space", "aria-hidden": "true" }, el("td"));
  const below = above.cloneNode(true);
  const pool = new Map();
  let order = [];
  let active = 0;
  let sorting = { key: "state", down: true };
  let open = () => {};

  function create(onOpen) {
    open = onOpen;
    head.replaceChildren(el("tr", { "aria-rowindex": 1 }, ...COLUMNS.map(heading)));
    body.replaceChildren(above, below);
    let asked = false;
    const later = () => {
      if (asked) return;
      asked = true;
      requestAnimationFrame(() => { asked = false; render(); });
    };
    box.addEventListener("scroll", later, { passive: true });
    new ResizeObserver(later).observe(box);
    body.addEventListener("keydown", onKey);
    body.addEventListener("click", (event) => {
      const row = event.target.closest("tr:not(.space)");
      if (row) openAt(Number(row.dataset.at));
    });
    Data.arrived.then(() => { pool.forEach((row) => row.remove()); pool.clear(); render(); });
  }

  function heading(column) {
    const attributes = { scope: "col", "data-key": column.key, style: { "--width": `${column.width}px` }, class: [column.right && "right", column.wide && "wide"].filter(Boolean).join(" ") };
    if (!column.value) return el("th", attributes, el("div", { class: "plain" }, column.title));
    const button = el("button", { type: "button", title: TITLES[column.key], "data-sort": column.key, onclick: () => sortBy(column.key) }, column.title);
    return el("th", { ...attributes, "aria-sort": "none" }, button);
  }

  /** Sort by a column; again turns the order round. */
  function sortBy(key) {
    sorting = { key, down: sorting.key === key ? !sorting.down : false };
    show(order);
  }

  /** Show these assets, in the chosen order; unknown values come last. */
  function show(indices) {
    const { value } = COLUMNS.find((column) => column.key === sorting.key);
    const sign = sorting.down ? -1 : 1;
    const compare = (a, b) => {
      const [x, y] = [value(a), value(b)];
      if (x === y) return a - b;
      if (x === null || y === null) return x === null ? 1 : -1;
      return sign * (x < y ? -1 : 1);
    };
    order = [...indices].sort(compare);
    active = 0;
    for (const button of head.querySelectorAll("button")) {
      const here = button.dataset.sort === sorting.key;
      button.parentElement.setAttribute("aria-sort", here ? (sorting.down ? "descending" : "ascending") : "none");
    }
    table.setAttribute("aria-rowcount", order.length + 1);
    pool.forEach((row) => row.remove());
    pool.clear();
    box.scrollTop = 0;
    render();
  }

  function render() {
    const first = Math.max(Math.floor(box.scrollTop / ROW) - SPARE, 0);
    // Before its rows are there, the box is as high as its head.
    const height = Math.max(box.clientHeight, innerHeight);
    const last = Math.min(Math.ceil((box.scrollTop + height) / ROW) + SPARE, order.length);
    above.firstChild.style.height = `${first * ROW}px`;
    below.firstChild.style.height = `${(order.length - last) * ROW}px`;
    for (const [at, row] of pool) {
      if (at < first || at >= last) { row.remove(); pool.delete(at); }
    }
    let before = above;
    for (let at = first; at < last; at++) {
      if (!pool.has(at)) pool.set(at, makeRow(at));
      const row = pool.get(at);
      if (before.nextSibling !== row) before.after(row);
      row.tabIndex = at === active ? 0 : -1;
      before = row;
    }
  }

  function makeRow(at) {
    const index = order[at];
    return el("tr", { "data-at": at, "aria-rowindex": at + 2, tabindex: -1 }, ...COLUMNS.map((column) => cell(column, index)));
  }

  function cell(column, index) {
    const kind = [column.right && "right", column.wide && "wide"].filter(Boolean).join(" ");
    if (column.key === "picture") {
      const picture = el("span", { class: "thumb", role: "img", "aria-label": `${ASSETS.id[index]} from three directions` });
      Data.showThumbnail(picture, index);
      return el("td", {}, picture);
    }
    if (column.key === "id") {
      return el("td", { class: "id", title: ASSETS.id[index] }, ASSETS.id[index]);
    }
    if (column.key === "state") {
      const [reasons, unusual] = [ASSETS.reasons[index], unusualOf(index)];
      const told = [...unusual, ...reasons.map(withoutPath)].join("; ");
      const mark = unusual.length ? [el("span", { class: "unusual", "aria-hidden": "true" }, "⚠")] : [];
      return el("td", { title: [...unusual, ...reasons].join("; ") }, stateTag(ASSETS.state[index]), ...mark, ...(told ? [el("small", {}, told)] : []));
    }
    return el("td", { class: kind, title: column.key === "category" ? column.text(index) : null }, column.text(index));
  }

  function onKey(event) {
    const page = Math.floor(box.clientHeight / ROW) - 1;
    const target = { ArrowDown: active + 1, ArrowUp: active - 1, PageDown: active + page, PageUp: active - page, Home: 0, End: order.length - 1 }[event.key];
    if (target !== undefined) {
      event.preventDefault();
      focusAt(target);
    } else if (event.key === "Enter" || event.key === " ") {
      event.preventDefault();
      openAt(active);
    }
  }

  function focusAt(at) {
    active = Math.min(Math.max(at, 0), order.length - 1);
    const header = head.offsetHeight;
    const top = active * ROW;
    if (top < box.scrollTop) box.scrollTop = top;
    if (top + ROW + header > box.scrollTop + box.clientHeight) box.scrollTop = top + ROW + header - box.clientHeight;
    render();
    pool.get(active)?.focus({ preventScroll: true });
  }

  function openAt(at) {
    active = at;
    open(order[at]);
  }

  /** Return the asset `step` rows away from one, or null at an end. */
  function neighbour(index, step) {
    const at = order.indexOf(index) + step;
    return order[at] ?? null;
  }

  return { create, show, neighbour, focus: (index) => focusAt(order.indexOf(index)) };
})();

function stateTag(name) {
  const state = STATES.find((known) => known.name === name);
  return el("span", { class: "tag", "data-state": name, "data-sign": state.sign }, name);
}
