/* What stands above the table: states, quality, properties, classes. */

const Sections = (() => {
  const stored = ASSETS.state.map((state) => STORED.includes(state));
  const known = (values) => values.filter((value) => value !== null);

  function states(filter) {
    const counts = STATES.map((state) => ({ ...state, count: CONTENT.all.states[state.name] ?? 0 }));
    const { stored: inStore, ambiguous, unusual } = CONTENT.all;
    byId("title").textContent = CONTENT.name || CONTENT.title;
    const engine = CONTENT.engine.join(", ");
    byId("lede").textContent =
      `${Format.plural(inStore, "asset")} in ${CONTENT.title}, aligned by the engine “${engine}”` +
      (CONTENT.records ? "." : ". The records of the build were not at hand, so this page does not know what did not go in, nor why a verdict is not good, nor which placements tie.");
    const valid = known(ASSETS.valid_share.map((share, k) => (share === null ? null : share * ASSETS.voxels[k])));
    const sum = (values) => values.reduce((total, value) => total + value, 0);
    const tiles = [
      ["stored assets good", Format.share(counts[0].count / inStore)],
      ["SLAT voxels", Format.count(CONTENT.voxels)],
      ["of them valid", Format.share(sum(valid) / sum(known(ASSETS.voxels)), 2)],
      ["median fitness", Format.fixed(3)(Format.quantile(known(ASSETS.fitness), 0.5))],
      ["median rmse, voxels", Format.fixed(3)(Format.quantile(known(ASSETS.inlier_rmse), 0.5))],
    ];
    const unphysical = sum(known(ASSETS.unphysical));
    if (unphysical) tiles.push(["unphysical voxels left out", Format.count(unphysical)]);
    tiles.push(["ambiguous", Format.count(ambiguous)]);
    const merged = known(ASSETS.spreads).length;
    if (merged) tiles.push(["assets with merged labels", Format.count(merged)]);
    byId("tiles").replaceChildren(...tiles.map(([name, value]) => el("div", {}, el("dt", {}, name), el("dd", {}, value))));
    const present = counts.filter((state) => state.count);
    byId("statebar").replaceChildren(
      ...present.map((state) => el("i", { "data-state": state.name, title: `${state.name}: ${state.count}`, style: { flex: `${state.count} 0 0`, background: "var(--tone)" } })),
    );
    byId("statelist").replaceChildren(
      ...counts.filter((state) => CONTENT.records || STORED.includes(state.name)).map((state) =>
        el("button", { type: "button", class: "chip", title: state.means, disabled: !state.count, onclick: () => filter.only({ states: [state.name] }) }, stateTag(state.name), ` ${Format.count(state.count)}`),
      ),
    );
    if (unusual) {
      byId("statelist").append(el("button", { type: "button", class: "chip", title: "values, masks, places or latents that few sources have", onclick: () => filter.only({ unusual: true }) }, `⚠ unusual ${Format.count(unusual)}`));
    }
    byId("statelist").append(...CONTENT.shared.map((line) => el("p", { class: "hint", style: { flex: "1 0 100%" } }, `⚠ ${line}`)));
    why(filter);
  }

  /** Group the reasons by what they have in common, most frequent first. */
  function why(filter) {
    const kinds = new Map();
    ASSETS.kinds.forEach((own, index) => {
      for (const kind of new Set(own)) {
        const state = ASSETS.state[index];
        const key = JSON.stringify([state, kind]);
        const entry = kinds.get(key) ?? { state, kind, example: ASSETS.reasons[index][own.indexOf(kind)], count: 0 };
        entry.count++;
        kinds.set(key, entry);
      }
    });
    const rows = [...kinds.values()].sort((a, b) => b.count - a.count);
    if (!rows.length) {
      byId("why").replaceChildren(el("p", { class: "hint" }, CONTENT.records ? "Every asset is in the store, and every alignment good." : "Unknown without the records."));
      return;
    }
    const list = el("div", { class: "why" });
    for (const row of rows.slice(0, 20)) {
      const text = row.count === 1 ? withoutPath(row.example) : row.kind.replace(/\bN\b/g, "…");
      list.append(
        el("span", { class: "number" }, Format.count(row.count)),
        stateTag(row.state),
        el("button", { type: "button", class: "link", title: row.example, onclick: () => filter.only({ states: [row.state], kind: row.kind }) }, text),
      );
    }
    byId("why").replaceChildren(list);
    if (rows.length > 20) byId("why").append(el("p", { class: "hint" }, `and ${Format.plural(rows.length - 20, "other reason")}; see the table`));
  }

  /** The four histograms over assets; each bar filters the table. */
  function quality(filter) {
    const top = (values, least, step) => Math.max(least, Math.ceil(Format.extent(values)[1] / step) * step);
    const low = (values) => Math.min(0.9, Math.floor(Format.extent(values)[0] * 20) / 20);
    const specs = [
      known(ASSETS.confidence).length
        ? { key: "confidence", title: "Confidence", text: Format.fixed(3), domain: [0, 1], good: [CONTENT.thresholds.confidence, "good from"] }
        : { key: "fitness", title: "Fitness", text: Format.fixed(3), domain: [low(known(ASSETS.fitness)), 1] },
      { key: "inlier_rmse", title: "Inlier rmse [voxel]", text: Format.fixed(3), domain: [0, top(known(ASSETS.inlier_rmse), 0.5, 0.1)] },
      { key: "displacement", title: "Displacement between tied placements [voxel]", text: Format.fixed(1), domain: [0, top(known(ASSETS.displacement), 5, 5)], empty: CONTENT.records ? "No asset has tied placements." : "Unknown without the records." },
      { key: "valid_share", title: "Valid share", text: (x) => Format.share(x), domain: [low(known(ASSETS.valid_share)), 1], good: [CONTENT.thresholds.valid_share, "good from"] },
    ];
    const figures = specs.map((spec) => {
      const bins = 40;
      const values = ASSETS[spec.key];
      const binned = Charts.byState(values, spec.domain, bins);
      const have = known(values);
      const figure = Charts.histogram({
        ...spec,
        ...binned,
        sub: have.length
          ? `${have.length < stored.filter(Boolean).length ? `${Format.plural(have.length, "asset")}, ` : ""}median ${spec.text(Format.quantile(have, 0.5))}`
          : "",
        marks: spec.good && spec.good[0] > spec.domain[0] ? [{ at: spec.good[0], text: `${spec.good[1]} ${spec.text(spec.good[0])}` }] : [],
        ticks: [0, 0.5, 1].map((t) => spec.domain[0] + t * (spec.domain[1] - spec.domain[0])).map((at) => ({ at, text: spec.text(at) })),
        describe: (k) => {
          const total = binned.bins[k].reduce((all, part) => all + part.count, 0);
          return `${spec.text(binned.edges[k])} to ${spec.text(binned.edges[k + 1])}: ${Format.plural(total, "asset")}`;
        },
        choose: (k) => filter.toggleBin({ key: spec.key, title: spec.title, bin: k, bins, domain: spec.domain, text: `${spec.text(binned.edges[k])} – ${spec.text(binned.edges[k + 1])}` }),
      });
      figure.dataset.key = spec.key;
      return figure;
    });
    byId("histograms").replaceChildren(...figures);
    filter.onBin((chosen) => figures.forEach((figure) => figure.press(chosen && chosen.key === figure.dataset.key ? chosen.bin : null)));
  }

  /** What decoys say: the scores of the assets, and of grids aligned with other objects' SLATs. */
  function errors() {
    const { told, edges, assets, decoys, kept } = CONTENT.errors;
    const sentence = (text) => `${text[0].toUpperCase()}${text.slice(1).replaceAll("`", "")}.`;
    byId("errors").textContent = told.map(sentence).join(" ");
    if (!edges) return;
    const domain = [edges[0], edges.at(-1)];
    const share = (odds) => (1 / (1 + Math.exp(-odds))).toFixed(4);
    const ticks = [1e-4, 0.01, 0.5, 0.99, 0.9999]
      .map((text) => ({ at: Math.log(text / (1 - text)), text: String(text) }))
      .filter(({ at }) => at >= domain[0] && at <= domain[1]);
    const [, most, least] = kept.find(([rate]) => rate === 0.01);
    const marks = least === null ? [] : [{ at: least, text: `1 % wrong: ${Format.count(most)} kept` }];
    const one = (title, counts, colour) =>
      Charts.histogram({
        title, edges, domain, ticks, marks,
        sub: "Score, as a probability that the object is the same",
        bins: counts.map((count) => [{ colour, count }]),
        describe: (k) => `${share(edges[k])} to ${share(edges[k + 1])}: ${Format.count(counts[k])}`,
      });
    byId("decoys").replaceChildren(
      one("Assets", assets, "var(--accent)"),
      one("Decoys: grids with SLATs of other objects", decoys, "var(--failed)"),
    );
  }

  function rotations(filter) {
    const turns = CONTENT.turns.map((words, turn) => {
      const own = ASSETS.turn.flatMap((one, index) => (one === turn ? [index] : []));
      return { words, turn, count: own.length, tilts: own.map((index) => ASSETS.tilt[index]) };
    });
    const found = turns.filter((one) => one.count).sort((a, b) => b.count - a.count);
    const total = stored.filter(Boolean).length;
    const most = found[0].count;
    const few = found.slice(0, 12);
    const rows = few.map((one) => ({
      label: one.words,
      choose: () => filter.only({ turn: one.turn }),
      parts: [{ share: one.count / most, title: `${one.words}: ${Format.plural(one.count, "asset")}` }],
      number: `${Format.share(one.count / total)} · tilt ${Format.quantile(one.tilts, 0.5).toFixed(1)}°`,
    }));
    byId("rotations").replaceChildren(
      el("h3", {}, "Dominant rotations"),
      el("p", { class: "hint" }, `Where the nearest of the 24 quarter turns takes the axes of the PixieVerse frame, the share of assets, and their median angle to it. ${found.length} of the 24 ${found.length === 1 ? "occurs" : "occur"}${found.length > few.length ? `; the ${few.length} most frequent are shown` : ""}.`),
      Charts.bars(rows),
    );
  }

  function properties() {
    const source = CONTENT.properties[0].source;
    const range = { dataset: "the smallest and largest value of the dataset that was built", pixie: "Pixie's published ranges" }[source] ?? (/^(p\d|dataset of)/.test(source) ? source : `the file ${source}`);
    byId("properties-hint").textContent =
      `Before: the annotated voxels of the PixieVerse fields in physical units, clipped to the range, not normalised. After: the valid SLAT voxels as the store holds them. ` +
      `Solid lines mark the range that becomes −1 to 1 (${range}); dashed lines, Pixie's published range.`;
    byId("property-charts").replaceChildren(...CONTENT.properties.flatMap((property) => [before(property), after(property)]));
  }

  function spread(property, counts) {
    const bins = counts[0].length;
    const parts = Array.from({ length: bins }, (_, k) => counts.map((own, id) => ({ colour: CONTENT.classes[id].colour, count: own[k] })));
    const totals = parts.map((own) => own.reduce((sum, part) => sum + part.count, 0));
    const all = totals.reduce((sum, count) => sum + count, 0);
    const largest = (k) => CONTENT.classes[parts[k].reduce((best, part, id) => (part.count > parts[k][best].count ? id : best), 0)].name;
    const say = (k) => `${Format.share(totals[k] / all)} of the voxels, most often ${largest(k)}`;
    return { parts, all, say };
  }

  const clipped = (count) => (count ? `${Format.count(count)} of them clipped` : "none clipped");

  function before(property) {
    const { name, unit } = PROPERTY_NAMES[property.name];
    const { parts, all, say } = spread(property, property.field);
    const pixie = property.pixie ?? [];
    const [lo, hi] = [Math.min(property.lo, ...pixie), Math.max(property.hi, ...pixie)];
    const margin = 0.04 * (hi - lo);
    const domain = [lo - margin, hi + margin];
    const edge = (k) => property.lo + ((property.hi - property.lo) * k) / parts.length;
    const edges = Array.from({ length: parts.length + 1 }, (_, k) => edge(k));
    const text = property.log10 ? Format.scientific : Format.within(property);
    const ticks = [];
    if (property.log10) for (let p = Math.ceil(domain[0]); p <= domain[1]; p += domain[1] - domain[0] > 6 ? 2 : 1) ticks.push({ at: p, text: Format.power(p) });
    else {
      const step = 10 ** Math.floor(Math.log10(domain[1] - domain[0]));
      const digits = Math.max(0, -Math.log10(step));
      for (let k = Math.ceil(domain[0] / step); k * step <= domain[1]; k++) ticks.push({ at: k * step, text: Format.fixed(digits)(k * step) });
    }
    return Charts.histogram({
      title: `${name}${unit && ` [${unit}]`}, before`,
      sub: `${Format.count(all)} voxels${property.clipped[0] ? `, ${clipped(property.clipped[0])}` : ""}, range ${text(property.lo)} to ${text(property.hi)}${unit && ` ${unit}`}`,
      edges, bins: parts, domain, ticks,
      marks: [
        { at: property.lo, text: text(property.lo), own: true },
        { at: property.hi, text: text(property.hi), own: true },
        ...pixie.map((at) => ({ at, text: "" })),
      ],
      describe: (k) => `${text(edges[k])} to ${text(edges[k + 1])} ${unit}: ${say(k)}`,
    });
  }

  function after(property) {
    const { name } = PROPERTY_NAMES[property.name];
    const { parts, all, say } = spread(property, property.slat);
    const edges = Array.from({ length: parts.length + 1 }, (_, k) => -1 + (2 * k) / parts.length);
    return Charts.histogram({
      title: `${name}, after`,
      sub: `${Format.count(all)} voxels, ${clipped(property.clipped[1])}`,
      edges, bins: parts, domain: [-1.04, 1.04],
      ticks: [-1, -0.5, 0, 0.5, 1].map((at) => ({ at, text: String(at).replace("-", "−") })),
      marks: [{ at: -1, text: "−1", own: true }, { at: 1, text: "1", own: true }],
      describe: (k) => `${Format.fixed(2)(edges[k])} to ${Format.fixed(2)(edges[k + 1])}: ${say(k)}`,
    });
  }

  function balance(filter) {
    const names = [...CONTENT.classes.map((one) => one.name), "not valid"];
    const colours = [...CONTENT.classes.map((one) => one.colour), CONTENT.scales.none];
    const rows = CONTENT.balance.map((row) => {
      const all = row.classes.reduce((sum, count) => sum + count, 0);
      return {
        label: row.category === "(unknown)" ? `"${row.category}"` : row.category || "(unknown)",
        choose: () => filter.only({ category: row.category, states: STORED }),
        parts: row.classes.flatMap((count, id) => (count ? [{ colour: colours[id], share: count / all, title: `${names[id]} ${Format.share(count / all)}` }] : [])),
        number: Format.plural(row.assets, "asset"),
      };
    });
    byId("balance").replaceChildren(Charts.bars(rows));
    for (const legend of document.querySelectorAll("[data-legend]")) {
      const entries = legend.dataset.legend === "classes" ? names.slice(0, -1) : names;
      legend.replaceChildren(...entries.map((name, id) => el("span", { style: { "--tone": colours[id] } }, name)));
    }
  }

  function colophon() {
    const { side, assets } = CONTENT.detail;
    const { stored: inStore, assets: total } = CONTENT.all;
    const notes = [];
    if (TOTAL < total) notes.push(`This page shows a sample: ${Format.count(TOTAL)} of ${Format.count(total)} assets are in its table and in its charts and medians; counts of assets by verdict and of ties, and of SLAT voxels, are of all.`);
    notes.push(`3D views show the cells of a ${side}³ grid${side < 64 ? ", to keep this page small," : ""} and each value as one of ${CONTENT.detail.levels} steps of its range.`);
    if (assets < inStore) notes.push(`${Format.count(assets)} of ${Format.count(inStore)} assets have a thumbnail and a 3D view, and make up the distributions: those with a doubtful or failed alignment first, the rest evenly chosen.`);
    byId("detail-hint").textContent = notes.join(" ");
    byId("colophon").textContent = `Made by slatprep ${CONTENT.versions.slatprep} from build ${CONTENT.build_id.slice(0, 12)}${CONTENT.created ? ` of ${CONTENT.created}` : ""}.`;
    byId("parameters").replaceChildren(...CONTENT.parameters.map(([name, value]) => el("li", {}, el("code", {}, `${name} = ${value}`))));
  }

  return { states, quality, errors, rotations, properties, balance, colophon };
})();
