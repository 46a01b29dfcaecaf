/* The page's data: the table at once, pictures and voxels when they are wanted. */

const CONTENT = JSON.parse(byId("content").textContent);
const ASSETS = CONTENT.assets;
const TOTAL = ASSETS.id.length;

const STATES = [
  { name: "good", sign: "✓", means: "probably the same object, rightly placed" },
  { name: "doubtful", sign: "?", means: "should be looked at" },
  { name: "failed", sign: "!", means: "probably another object, or wrongly placed" },
  { name: "not built", sign: "✕", means: "could not be used, not in the store" },
  { name: "skipped", sign: "–", means: "a partner is missing, not in the store" },
];

/** The states of what is in the store. */
const STORED = STATES.slice(0, 3).map((state) => state.name);

/** Say what is unusual of an asset's sources, a text for each kind. */
const unusualOf = (index) => (ASSETS.unusual[index] ?? []).map((line) => `unusual ${line}`);

/** A reason without the path that it begins with. */
const withoutPath = (reason) => reason.replace(new RegExp(CONTENT.path), "");

const SYMBOLS = { __proto__: null, youngs_modulus: "E", density: "ρ", poissons_ratio: "ν" };
const PROPERTY_NAMES = {};
for (const property of CONTENT.properties) {
  const { name, title, unit } = property;
  property.key = `property.${name}`; // A source may call a property anything, "distance" too.
  PROPERTY_NAMES[name] = { name: title[0].toUpperCase() + title.slice(1), symbol: SYMBOLS[name] ?? title, unit };
}

const Data = (() => {
  const { per_sheet: perSheet, columns, views, side, levels } = CONTENT.detail;
  const THUMB = 58;
  const sheets = new Map();
  const arrived = new Promise((resolve) => {
    if (document.readyState !== "loading") resolve();
    else document.addEventListener("DOMContentLoaded", () => resolve(), { once: true });
  });

  const bytesOf = (base64) =>
    Uint8Array.fromBase64
      ? Uint8Array.fromBase64(base64)
      : Uint8Array.from(atob(base64), (character) => character.charCodeAt(0));

  function sheetUrl(number) {
    if (!sheets.has(number)) {
      const block = byId(`sheet-${number}`);
      if (!block) return null; // Still being read; asked again when it has arrived.
      const image = new Blob([bytesOf(block.textContent)], { type: "image/png" });
      sheets.set(number, URL.createObjectURL(image));
    }
    return sheets.get(number);
  }

  /** Show asset `index` as the background of an element of 3 x 1 tiles. */
  function showThumbnail(element, index) {
    const picture = ASSETS.picture[index];
    const url = picture === null ? null : sheetUrl(Math.floor(picture / perSheet));
    element.hidden = picture === null;
    if (!url) {
      element.style.backgroundImage = "none";
      return;
    }
    const place = picture % perSheet;
    element.style.backgroundImage = `url(${url})`;
    element.style.backgroundSize = `${columns * views * THUMB}px auto`;
    element.style.backgroundPosition =
      `${-(place % columns) * views * THUMB}px ${-Math.floor(place / columns) * THUMB}px`;
  }

  /** Return the voxels of an asset; null where the page holds none. */
  async function voxels(index) {
    const picture = ASSETS.picture[index];
    if (picture === null) return null;
    await arrived;
    const pack = byId(`pack-${Math.floor(picture / perSheet)}`).textContent.split("\n");
    const stream = new Blob([bytesOf(pack[picture % perSheet])]).stream();
    const plain = stream.pipeThrough(new DecompressionStream("deflate-raw"));
    return decode(new Uint8Array(await new Response(plain).arrayBuffer()));
  }

  function decode(bytes) {
    let at = 0;
    const take = (length) => bytes.subarray(at, (at += length));
    const slat = coordinates(take(side ** 3 / 8));
    const field = coordinates(take(side ** 3 / 8));
    const n = slat.length / 3;
    const material = take(n);
    const properties = Object.fromEntries(CONTENT.properties.map(({ key }) => [key, take(n)]));
    const distance = take(n);
    const fieldMaterial = take(field.length / 3);
    return { slat, field, material, ...properties, distance, fieldMaterial, moved: at < bytes.length ? steps(take(bytes.length - at)) : null };
  }

  /** How far each boundary voxel moves in its own frame, in edges of the cube; see voxels.py. */
  function steps(bytes) {
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
    const step = view.getFloat32(0, true);
    return Float32Array.from({ length: bytes.length - 4 }, (_, k) => step * view.getInt8(4 + k));
  }

  /** Unpack an occupancy into voxels x, y, z, in C order. */
  function coordinates(bits) {
    const found = [];
    for (let byte = 0; byte < bits.length; byte++) {
      for (let bit = 0, value = bits[byte]; value; bit++, value = (value << 1) & 255) {
        if (!(value & 128)) continue;
        const cell = byte * 8 + bit;
        found.push(Math.floor(cell / (side * side)), Math.floor(cell / side) % side, cell % side);
      }
    }
    return Uint8Array.from(found);
  }

  /** Return the mapped value (log10 or plain) of a property's step. */
  const mapped = (property, step) => property.lo + (step / (levels - 1)) * (property.hi - property.lo);

  /** Return the mean spread of an asset's normalised properties; null where nothing was merged. */
  function spread(index) {
    const own = (ASSETS.spreads[index] ?? []).filter((value) => value !== null);
    return own.length ? own.reduce((sum, value) => sum + value, 0) / own.length : null;
  }

  return { arrived, spread, showThumbnail, voxels, mapped, side, levels, NOT_VALID: 255 };
})();
