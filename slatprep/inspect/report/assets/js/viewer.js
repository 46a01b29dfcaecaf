/* One asset in 3D. The library is read when the first asset is opened. */

const Viewer = (() => {
  const { side, levels, NOT_VALID } = Data;
  const MODES = [
    { key: "material", title: "Class" },
    ...CONTENT.properties.map((property) => ({ key: property.key, title: PROPERTY_NAMES[property.name].symbol, property })),
    { key: "distance", title: "Distance" },
  ];
  const AXIS = 0.22;
  const AXIS_COLOURS = ["#d1453b", "#3a9a4b", "#3f7fd6"];
  const canvas = byId("canvas");
  const reduced = matchMedia("(prefers-reduced-motion: reduce)");
  let three = null; // renderer, scene, camera, controls, key light
  let shown = null; // voxels and meshes of the asset on the stage
  let frame = 0;
  let stale = true; // whether the stage shows something else than it should
  const state = { mode: "material", slat: true, field: false, before: false, tie: 0, turning: !reduced.matches };

  function library() {
    if (typeof THREE === "undefined") {
      const script = document.createElement("script");
      script.textContent = byId("library").textContent;
      document.head.append(script);
    }
    return THREE;
  }

  function start() {
    const { WebGLRenderer, Scene, PerspectiveCamera, OrbitControls, HemisphereLight, DirectionalLight } = library();
    const renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true });
    const scene = new Scene();
    const camera = new PerspectiveCamera(35, 1, 0.05, 20);
    camera.up.set(0, 0, 1); // z points up in both frames
    camera.position.set(1.15, -1.75, 0.95);
    scene.add(new HemisphereLight(0xffffff, 0x8a8f9a, 1.5));
    const light = new DirectionalLight(0xffffff, 2.1);
    light.position.set(-1.1, 0.5, 1);
    camera.add(light);
    scene.add(camera);
    const controls = new OrbitControls(camera, canvas);
    controls.enableDamping = true;
    controls.autoRotateSpeed = 1.6;
    controls.minDistance = 0.7;
    controls.maxDistance = 6;
    controls.addEventListener("start", () => setTurning(false));
    new ResizeObserver(resize).observe(canvas);
    canvas.addEventListener("pointermove", (event) => (pointer = event));
    canvas.addEventListener("pointerleave", () => { pointer = null; byId("readout").replaceChildren(); });
    canvas.addEventListener("keydown", onKey);
    three = { renderer, scene, camera, controls };
    addFrame();
    resize();
  }

  let pointer = null;

  /** The unit cube that both frames share, drawn thin, and the axes from its lowest corner. */
  function addFrame() {
    const { BoxGeometry, EdgesGeometry, InstancedMesh, LineSegments, LineBasicMaterial, Matrix4, MeshLambertMaterial, Vector3 } = THREE;
    const material = new LineBasicMaterial({ color: 0x8a94a1, transparent: true, opacity: 0.5 });
    three.scene.add(new LineSegments(new EdgesGeometry(new BoxGeometry(1, 1, 1)), material));
    three.axes = ["x", "y", "z"].map((name, axis) => {
      const along = (size, across) => [0, 1, 2].map((k) => (k === axis ? size : across));
      const bar = new InstancedMesh(new BoxGeometry(...along(AXIS, 0.008)), new MeshLambertMaterial({ color: AXIS_COLOURS[axis] }), 1);
      bar.setMatrixAt(0, new Matrix4().makeTranslation(...along(AXIS / 2 - 0.5, -0.5)));
      three.scene.add(bar);
      const label = el("span", { class: "axis-name", "aria-hidden": "true", style: { "--tone": AXIS_COLOURS[axis] } }, name);
      canvas.after(label);
      return { label, end: new Vector3(...along(AXIS - 0.47, -0.5)) };
    });
  }

  /** Put the names of the axes where their ends are seen. */
  function placeNames() {
    for (const { label, end } of three.axes) {
      const seen = end.clone().project(three.camera);
      label.style.left = `${(seen.x + 1) * 0.5 * canvas.clientWidth}px`;
      label.style.top = `${(1 - seen.y) * 0.5 * canvas.clientHeight}px`;
    }
  }

  function resize() {
    const { clientWidth: width, clientHeight: height } = canvas;
    if (!three || !width || !height) return;
    three.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    three.renderer.setSize(width, height, false);
    three.camera.aspect = width / height;
    three.camera.fov = width < 1.2 * height ? 48 : 35; // so that the axes are seen, too
    three.camera.updateProjectionMatrix();
    stale = true;
  }

  /** Put an asset on the stage; `message` says why where there is nothing to see. */
  async function show(index) {
    clear();
    const message = byId("message");
    message.textContent = ASSETS.picture[index] === null ? "This asset has no 3D view on this page." : "";
    byId("scale").replaceChildren();
    if (ASSETS.picture[index] === null) return draw();
    await Data.arrived; // the library, too: an address may open an asset while the page is read
    try {
      if (!three) start();
    } catch (error) {
      message.textContent = `This browser cannot draw in 3D (${error.message}).`;
      return;
    }
    const voxels = await Data.voxels(index);
    clear(); // another asset may have come while this one was unpacked
    const slat = instances(voxels.slat, 0.94);
    const field = instances(voxels.field, 0.94);
    state.tie = 0;
    shown = { index, voxels, slat, field, last: lastSteps(voxels) };
    three.scene.add(slat, field);
    update();
    loop();
  }

  /** The step at the end of each colour scale: a distance's is the largest there is. */
  function lastSteps(voxels) {
    const largest = voxels.distance.reduce((most, step) => (step < levels && step > most ? step : most), 1);
    return { ...Object.fromEntries(MODES.map((mode) => [mode.key, levels - 1])), distance: largest };
  }

  function matrixOf(rows) {
    return new THREE.Matrix4().set(...rows, 0, 0, 0, 1);
  }

  function instances(coordinates, size) {
    const { BoxGeometry, InstancedMesh, Matrix4, MeshLambertMaterial } = THREE;
    const count = coordinates.length / 3;
    const edge = size / side;
    const mesh = new InstancedMesh(new BoxGeometry(edge, edge, edge), new MeshLambertMaterial(), count);
    const place = new Matrix4();
    for (let k = 0; k < count; k++) {
      const [x, y, z] = [0, 1, 2].map((axis) => (coordinates[3 * k + axis] + 0.5) / side - 0.5);
      mesh.setMatrixAt(k, place.makeTranslation(x, y, z));
    }
    mesh.matrixAutoUpdate = false;
    return mesh;
  }

  /** Put each boundary voxel where the deformation has it before the transform, or where it was. */
  function deform(field, { field: coordinates, moved }, before) {
    if (!moved) return;
    const place = new THREE.Matrix4();
    for (let k = 0; k < field.count; k++) {
      const [x, y, z] = [0, 1, 2].map((axis) => (coordinates[3 * k + axis] + 0.5) / side - 0.5 + (before ? 0 : moved[3 * k + axis]));
      field.setMatrixAt(k, place.makeTranslation(x, y, z));
    }
    field.instanceMatrix.needsUpdate = true;
  }

  function clear() {
    if (!shown) return;
    for (const mesh of [shown.slat, shown.field]) {
      three.scene.remove(mesh);
      mesh.geometry.dispose();
      mesh.material.dispose();
      mesh.dispose();
    }
    shown = null;
  }

  /** Colour and show what the switches say. */
  function update() {
    if (!shown) return;
    const { slat, field, voxels } = shown;
    const both = state.slat && state.field;
    slat.visible = state.slat;
    field.visible = state.field;
    paint(slat, voxels[state.mode], coloursOf(state.mode));
    // Beside the SLAT the boundary is one colour: it is its place that matters then.
    const alone = coloursOf("material");
    paint(field, both ? null : voxels.fieldMaterial, both ? [new THREE.Color(BOUNDARY_COLOUR)] : alone);
    slat.material.transparent = both;
    slat.material.opacity = both ? 0.45 : 1;
    slat.material.depthWrite = !both;
    slat.material.needsUpdate = true;
    // What was fitted to the shapes belongs to the placement that was taken.
    deform(field, voxels, state.before || state.tie > 0);
    const transform = state.tie ? ASSETS.ties[shown.index][state.tie - 1] : ASSETS.transform[shown.index];
    field.matrix.copy(state.before ? new THREE.Matrix4() : matrixOf(transform));
    field.matrixWorldNeedsUpdate = true;
    byId("scale").replaceChildren(scaleOf(state.mode));
    stale = true;
  }

  function paint(mesh, steps, colours) {
    for (let k = 0; k < mesh.count; k++) mesh.setColorAt(k, steps ? colours[steps[k]] ?? colours.none : colours[0]);
    mesh.instanceColor.needsUpdate = true;
  }

  const BOUNDARY_COLOUR = "#ffffff";
  const stopsOf = (mode) => (mode === "distance" ? CONTENT.scales.distance : CONTENT.scales.property);

  /** The colour of each step of a mode; `none` is for voxels that are not valid. */
  function coloursOf(mode) {
    const { Color } = THREE;
    let colours;
    if (mode === "material") colours = CONTENT.classes.map((one) => new Color(one.colour));
    else {
      const stops = stopsOf(mode).map((stop) => new Color(stop));
      colours = Array.from({ length: levels }, (_, step) => {
        const at = Math.min(step / shown.last[mode], 1) * (stops.length - 1);
        const low = Math.min(Math.floor(at), stops.length - 2);
        return stops[low].clone().lerp(stops[low + 1], at - low);
      });
    }
    colours.none = new Color(CONTENT.scales.none);
    return colours;
  }

  function scaleOf(mode) {
    if (mode === "material") {
      const present = new Set(shown.voxels.material);
      const classes = CONTENT.classes.filter((_, id) => present.has(id));
      if (present.has(NOT_VALID)) classes.push({ name: "not valid", colour: CONTENT.scales.none });
      if (state.field && state.slat) classes.push({ name: "PixieVerse boundary", colour: BOUNDARY_COLOUR });
      return el("div", { class: "legend" }, ...classes.map((one) => el("span", { style: { "--tone": one.colour } }, one.name)));
    }
    const gradient = `linear-gradient(to right, ${stopsOf(mode).join(", ")})`;
    const [low, high] = [0, shown.last[mode]].map((step) => valueOf(mode, step));
    return el("div", { class: "ramp" }, el("span", {}, low), el("i", { style: { background: gradient } }), el("span", {}, high));
  }

  function valueOf(mode, step) {
    if (step === NOT_VALID) return "not valid";
    if (mode === "material") return CONTENT.classes[step].name;
    if (mode === "distance") return `${((step / (levels - 1)) * CONTENT.scales.max_distance).toFixed(1)} voxel`;
    const { property } = MODES.find((one) => one.key === mode);
    const { symbol, unit } = PROPERTY_NAMES[property.name];
    const value = Data.mapped(property, step);
    return `${symbol} ${property.log10 ? Format.scientific(value) : Format.within(property)(value)} ${unit}`.trim();
  }

  /** Say what is under the pointer. */
  function point() {
    if (!pointer || pointer.buttons) return;
    const { clientX, clientY } = pointer;
    pointer = null;
    const { left, top, width, height } = canvas.getBoundingClientRect();
    const { Raycaster, Vector2 } = THREE;
    const ray = new Raycaster();
    ray.setFromCamera(new Vector2((2 * (clientX - left)) / width - 1, 1 - (2 * (clientY - top)) / height), three.camera);
    const [hit] = state.slat ? ray.intersectObject(shown.slat) : [];
    if (!hit) return byId("readout").replaceChildren();
    const k = hit.instanceId;
    const where = [0, 1, 2].map((axis) => shown.voxels.slat[3 * k + axis]).join(", ");
    const facts = MODES.map((mode) => valueOf(mode.key, shown.voxels[mode.key][k]));
    byId("readout").replaceChildren(`(${where})  ${facts.join(" · ")}`);
  }

  function loop() {
    cancelAnimationFrame(frame);
    if (!shown || !byId("asset").open) return;
    frame = requestAnimationFrame(loop);
    three.controls.autoRotate = state.turning;
    const moved = three.controls.update();
    point();
    if (moved || stale) draw();
    stale = false;
  }

  function draw() {
    if (!three) return;
    three.renderer.render(three.scene, three.camera);
    placeNames();
  }

  function onKey(event) {
    const turn = { ArrowLeft: [-0.12, 0], ArrowRight: [0.12, 0], ArrowUp: [0, -0.12], ArrowDown: [0, 0.12] }[event.key];
    const zoom = { "+": 0.88, "=": 0.88, "-": 1.14 }[event.key];
    if (!turn && !zoom) return;
    event.preventDefault();
    setTurning(false);
    const { position } = three.camera;
    let radius = position.length();
    let around = Math.atan2(position.y, position.x);
    let up = Math.acos(position.z / radius);
    if (turn) { around += turn[0]; up = Math.min(Math.max(up + turn[1], 0.05), Math.PI - 0.05); }
    if (zoom) radius = Math.min(Math.max(radius * zoom, 0.7), 6);
    position.set(radius * Math.sin(up) * Math.cos(around), radius * Math.sin(up) * Math.sin(around), radius * Math.cos(up));
  }

  function setTurning(turning) {
    state.turning = turning;
    document.querySelector("[data-switch=turning]")?.setAttribute("aria-pressed", String(turning));
  }

  /** Make the switches beside the stage. */
  function create() {
    const modes = MODES.map((mode) =>
      el("button", { type: "button", class: "chip", "data-mode": mode.key, title: mode.property && PROPERTY_NAMES[mode.property.name].name, "aria-pressed": String(mode.key === state.mode), onclick: () => setMode(mode.key) }, mode.title),
    );
    byId("colour-by").append(...modes);
    const switches = { slat: "SLAT", field: "PixieVerse boundary", before: "before alignment", turning: "turn" };
    byId("show").append(
      ...Object.entries(switches).map(([key, title]) =>
        el("button", { type: "button", class: "chip", "data-switch": key, "aria-pressed": String(state[key]), onclick: (event) => flip(key, event.currentTarget) }, title),
      ),
    );
  }

  function setMode(mode) {
    state.mode = mode;
    document.querySelectorAll("[data-mode]").forEach((button) => button.setAttribute("aria-pressed", String(button.dataset.mode === mode)));
    update();
  }

  /** Show the PixieVerse side in another of its tied placements; 0 is the one taken. */
  function place(tie) {
    state.tie = tie;
    const turn = (key, wanted) => { if (state[key] !== wanted) document.querySelector(`[data-switch=${key}]`).click(); };
    turn("before", false);
    turn("field", true);
    turn("slat", false); // beside it the boundary has no classes, in which ties differ
    update();
  }

  function flip(key, button) {
    state[key] = !state[key];
    button.setAttribute("aria-pressed", String(state[key]));
    // What is before the alignment is the boundary, so it has to be seen.
    if (key === "before" && state.before && !state.field) document.querySelector("[data-switch=field]").click();
    update();
  }

  return { create, show, update, place, stop: clear };
})();
