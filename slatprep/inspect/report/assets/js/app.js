/* Filters, theme, and one asset: what ties the parts together. */

const Filter = (() => {
  const initial = () => ({ text: "", category: null, model: null, states: null, unusual: null, kind: null, turn: null, bin: null });
  let chosen = initial();
  let listeners = [];
  const haystack = ASSETS.id.map((id, k) => `${id}\n${ASSETS.category[k]}\n${[...ASSETS.reasons[k], ...unusualOf(k)].join("\n")}`.toLowerCase());

  function matches(index) {
    const { text, category, model, states, unusual, kind, turn, bin } = chosen;
    return (
      (!text || haystack[index].includes(text)) &&
      (category === null || ASSETS.category[index] === category) &&
      (model === null || ASSETS.model[index] === model) &&
      (states === null || states.includes(ASSETS.state[index])) &&
      (unusual === null || unusualOf(index).length > 0) &&
      (kind === null || ASSETS.kinds[index].includes(kind)) &&
      (turn === null || ASSETS.turn[index] === turn) &&
      (bin === null || (ASSETS[bin.key][index] !== null && Charts.binOf(ASSETS[bin.key][index], bin.domain, bin.bins) === bin.bin))
    );
  }

  function apply() {
    const found = [];
    for (let index = 0; index < TOTAL; index++) if (matches(index)) found.push(index);
    Table.show(found);
    byId("count").textContent = found.length === TOTAL ? `${Format.plural(TOTAL, "asset")}` : `${Format.count(found.length)} of ${Format.plural(TOTAL, "asset")}`;
    if (!found.length) byId("count").textContent += ": none matches; clear the search or remove a filter";
    for (const chip of document.querySelectorAll("#state-chips .chip")) {
      chip.setAttribute("aria-pressed", String(chosen.states?.includes(chip.dataset.state) ?? false));
    }
    byId("category").value = chosen.category === null ? "*" : `=${chosen.category}`;
    byId("model").value = chosen.model === null ? "*" : `=${chosen.model}`;
    if (byId("search").value.toLowerCase().trim() !== chosen.text) byId("search").value = chosen.text;
    const applied = [];
    if (chosen.unusual !== null) applied.push(["unusual", "unusual"]);
    if (chosen.kind !== null) applied.push(["kind", `reason: ${chosen.kind.replace(/\bN\b/g, "…")}`]);
    if (chosen.turn !== null) applied.push(["turn", `rotation: ${CONTENT.turns[chosen.turn]}`]);
    if (chosen.bin !== null) applied.push(["bin", `${chosen.bin.title}: ${chosen.bin.text}`]);
    byId("applied").replaceChildren(
      ...applied.map(([key, text]) => el("button", { type: "button", class: "chip", "aria-pressed": "true", "aria-label": `Remove the filter ${text}`, onclick: () => set({ [key]: null }) }, `${text} ✕`)),
    );
    listeners.forEach((listener) => listener(chosen.bin));
  }

  function set(change) {
    chosen = { ...chosen, ...change };
    apply();
  }

  /** Show only what has this, and bring the table into view. */
  function only(change) {
    chosen = { ...initial(), ...change };
    apply();
    byId("assets").scrollIntoView();
  }

  const same = (a, b) => a && b && a.key === b.key && a.bin === b.bin;
  const toggleBin = (bin) => set({ bin: same(chosen.bin, bin) ? null : bin });

  function toggleState(name) {
    const states = new Set(chosen.states ?? []);
    if (!states.delete(name)) states.add(name);
    set({ states: states.size ? [...states] : null });
  }

  function create() {
    byId("search").addEventListener("input", (event) => set({ text: event.target.value.toLowerCase().trim() }));
    byId("filters").addEventListener("submit", (event) => event.preventDefault());
    for (const key of ["category", "model"]) {
      const names = [...new Set(ASSETS[key].filter((name) => name !== null))].sort();
      byId(key).append(el("option", { value: "*" }, "all"), ...names.map((name) => el("option", { value: `=${name}` }, name || "(unknown)")));
      byId(key).addEventListener("change", (event) => set({ [key]: event.target.value === "*" ? null : event.target.value.slice(1) }));
    }
    byId("state-chips").append(
      ...STATES.filter((state) => ASSETS.state.includes(state.name)).map((state) =>
        el("button", { type: "button", class: "chip", "data-state": state.name, "aria-pressed": "false", title: state.means, onclick: () => toggleState(state.name) }, stateTag(state.name)),
      ),
    );
  }

  return { create, apply, only, toggleBin, onBin: (listener) => listeners.push(listener) };
})();

const Theme = (() => {
  const system = matchMedia("(prefers-color-scheme: dark)");
  let choice = null;
  function apply() {
    const dark = choice ? choice === "dark" : system.matches;
    const root = document.documentElement;
    if (choice) root.dataset.theme = choice;
    root.toggleAttribute("data-dark", dark);
    byId("theme").textContent = dark ? "☀ Light" : "☾ Dark";
    byId("theme").setAttribute("aria-label", dark ? "Use light colours" : "Use dark colours");
    Viewer.update();
  }
  function create() {
    system.addEventListener("change", apply);
    byId("theme").addEventListener("click", () => {
      choice = document.documentElement.hasAttribute("data-dark") ? "light" : "dark";
      apply();
    });
    apply();
  }
  return { create };
})();

const Detail = (() => {
  const dialog = byId("asset");
  let index = null;

  function open(asked) {
    index = asked;
    const value = (name) => ASSETS[name][index];
    byId("asset-title").replaceChildren(value("id"), el("small", {}, value("category") || "category unknown"));
    const { means } = STATES.find((state) => state.name === value("state"));
    const parts = ["confidence", "same_object", "right_placement"].map(value);
    const [confidence, object, placement] = parts.map((share) => Format.share(share));
    const rests = parts[0] === null ? means : `confidence ${confidence} = same object ${object} × right placement ${placement}`;
    byId("asset-state").replaceChildren(stateTag(value("state")), `: ${rests}`);
    byId("asset-reasons").replaceChildren(...[...value("reasons"), ...unusualOf(index)].map((reason) => el("li", {}, reason)));
    byId("asset-figures").replaceChildren(...figures(value));
    byId("previous").disabled = Table.neighbour(index, -1) === null;
    byId("next").disabled = Table.neighbour(index, 1) === null;
    byId("readout").replaceChildren();
    byId("copy").textContent = "Copy id";
    placements(value("ties") ?? []);
    if (!dialog.open) dialog.showModal();
    history.replaceState(null, "", `#asset=${encodeURIComponent(value("id"))}`);
    Viewer.show(index);
  }

  /** Offer the placements that fit as well as the one taken, as the records have them. */
  function placements(ties) {
    const all = byId("ties");
    all.hidden = !ties.length;
    const names = ["as taken", ...ties.map((_, k) => `tie ${k + 1}`)];
    const choose = (chosen) => {
      Viewer.place(chosen);
      [...all.querySelectorAll("button")].forEach((button, k) => button.setAttribute("aria-pressed", String(k === chosen)));
    };
    all.replaceChildren(
      all.querySelector("legend"),
      ...names.map((name, k) => el("button", { type: "button", class: "chip", "aria-pressed": String(k === 0), onclick: () => choose(k) }, name)),
    );
  }

  async function copy() {
    try {
      await navigator.clipboard.writeText(ASSETS.id[index]);
      byId("copy").textContent = "Copied";
    } catch {
      byId("copy").textContent = "Not allowed here";
    }
  }

  function figures(value) {
    if (value("fitness") === null) return [];
    const fixed = Format.fixed(3);
    const matrix = value("transform");
    const rows = [0, 4, 8].map((k) => matrix.slice(k, k + 4).map((x) => x.toFixed(4).replace("-", "−").padStart(8)).join(" "));
    const list = [
      ["Confidence", fixed(value("confidence"))],
      ["Expected accuracy", Format.share(value("expected_accuracy"))],
      ["Fitness", fixed(value("fitness"))],
      ["Fitness backward", fixed(value("fitness_backward"))],
      ["Inlier rmse", `${fixed(value("inlier_rmse"))} voxel`],
      ["Overlap", fixed(value("overlap"))],
      ["Valid share", Format.share(value("valid_share"), 2)],
      ["Ambiguity", Format.share(value("ambiguity"))],
      ["Tied placements", value("tied") === null ? Format.NONE : Format.count(value("tied"))],
      ["Displacement between them", value("displacement") === null ? Format.NONE : `${value("displacement").toFixed(1)} voxel`],
      ["Margin", fixed(value("margin"))],
      ["SLAT voxels", Format.count(value("voxels"))],
      ["Unphysical voxels left out", Format.count(value("unphysical"))],
      ["Nearest quarter turn", CONTENT.turns[value("turn")]],
      ["Angle to it", `${value("tilt").toFixed(1)}°`],
      ...merged(value),
      [`Transform (${value("model")})`, ""],
    ];
    return [...list.flatMap(([name, text]) => [el("dt", {}, name), el("dd", {}, text)]), el("dd", { class: "matrix" }, rows.join("\n"))];
  }

  /** What several annotations say: a spread of log10 is a factor, others are differences. */
  function merged(value) {
    if (value("spreads") === null) return [];
    const spreads = value("spreads").flatMap((spread, k) => {
      const { name, log10, lo, hi } = CONTENT.properties[k];
      const known = PROPERTY_NAMES[name];
      const width = (spread * (hi - lo)) / 2;
      const text = log10 ? `factor ${(10 ** width).toFixed(2)}` : `± ${Number(width.toPrecision(2))} ${known.unit}`;
      return spread === null ? [] : [[`${known.name}, spread`, text]];
    });
    return [["Annotations merged", Format.annotations(value("annotations"))], ["Votes for the class", Format.share(value("votes"))], ...spreads];
  }

  function step(by) {
    const next = Table.neighbour(index, by);
    if (next !== null) open(next);
  }

  /** Return the row that a name means: an id, a beginning that no other id has, or a number. */
  function named(name) {
    const whole = ASSETS.id.indexOf(name);
    if (whole >= 0 || !name) return whole < 0 ? undefined : whole;
    const begun = ASSETS.id.flatMap((id, row) => (id.startsWith(name) ? [row] : []));
    if (begun.length || !/^\d+$/.test(name)) return begun.length === 1 ? begun[0] : undefined;
    return Number(name) < ASSETS.id.length ? Number(name) : undefined;
  }

  /** Open the asset that the address names. */
  function fromAddress() {
    const [, id] = location.hash.match(/^#asset=(.*)$/) ?? [];
    byId("nowhere").hidden = true;
    if (id === undefined) return;
    let name = id;
    try { name = decodeURIComponent(id); } catch { /* taken as it stands */ }
    const found = named(name);
    if (found === undefined) {
      byId("nowhere").textContent = `No asset of this page, or more than one, is named “${name}”.`;
      byId("nowhere").hidden = false;
    } else if (found !== index) open(found);
  }

  function create() {
    byId("close").addEventListener("click", () => dialog.close());
    byId("copy").hidden = !navigator.clipboard;
    byId("copy").addEventListener("click", copy);
    byId("previous").addEventListener("click", () => step(-1));
    byId("next").addEventListener("click", () => step(1));
    dialog.addEventListener("keydown", (event) => {
      const by = { PageUp: -1, PageDown: 1 }[event.key];
      if (!by) return;
      event.preventDefault();
      step(by);
    });
    dialog.addEventListener("click", (event) => { if (event.target === dialog) dialog.close(); });
    dialog.addEventListener("close", () => {
      Viewer.stop();
      history.replaceState(null, "", location.pathname + location.search);
      Table.focus(index);
      index = null;
    });
    addEventListener("hashchange", fromAddress);
    fromAddress();
  }

  return { create, open };
})();

Viewer.create();
Theme.create();
Sections.states(Filter);
Sections.quality(Filter);
Sections.errors();
Sections.rotations(Filter);
Sections.properties();
Sections.balance(Filter);
Sections.colophon();
Filter.create();
Table.create(Detail.open);
Filter.apply();
Detail.create();
requestAnimationFrame(() => performance.mark("slatprep-ready"));
