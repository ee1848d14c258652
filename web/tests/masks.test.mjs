// The masks of a result, without a browser: numbers, colours and words.

import assert from "node:assert/strict";
import { before, test } from "node:test";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

/** Width of a small picture that is saved, see clip.ts. */
const SAVED_WIDTH = 480;

let page;
before(async () => {
  // What the parts under test ask of a browser.
  globalThis.document = { createElement: (tag) => new Element(tag) };
  globalThis.ImageData = class {
    constructor(columns, rows) {
      this.data = new Uint8ClampedArray(4 * rows * columns);
    }
  };
  const files = ["clip", "colour", "format", "masks", "picture", "volume"];
  const { outputFiles } = await build({
    stdin: {
      contents: files.map((name) => `export * from "./${name}";`).join("\n"),
      resolveDir: fileURLToPath(new URL("../src", import.meta.url)),
    },
    bundle: true,
    write: false,
    format: "esm",
  });
  page = await import(`data:text/javascript;base64,${Buffer.from(outputFiles[0].contents).toString("base64")}`);
});

class Element {
  style = {};
  listeners = {};
  children = [];
  marks = [];
  hidden = false;
  constructor(tag) {
    this.tag = tag;
  }
  setAttribute(name, value) {
    this[name] = name === "width" || name === "height" ? Number(value) : value;
  }
  addEventListener(name, listener) {
    this.listeners[name] = listener;
  }
  append(...children) {
    this.children.push(...children);
  }
  getContext() {
    return { canvas: this, putImageData: () => undefined, fillRect: (...rect) => this.marks.push(rect) };
  }
  get text() {
    return this.children.map((c) => c.text ?? c).join("");
  }
}

/** Three bins of 2×2; pixel 3 is observed in no bin, pixel 1 not in bin 1. */
function coverage(fraction = 0.75) {
  const seen = [254, 254, 254, 0, 254, 0, 254, 0, 254, 254, 254, 0];
  return new page.Coverage(new page.Volume([3, 2, 2], [0, 1], 8, Uint8Array.from(seen)), fraction);
}

const chosen = (isChosen) => [0, 1, 2, 3].filter(isChosen);

test("voxels that are not observed are told for a bin and for all bins", () => {
  assert.deepEqual(chosen(coverage().unobservedIn(0)), [3]);
  assert.deepEqual(chosen(coverage().unobservedIn(1)), [1, 3]);
  assert.deepEqual(chosen(coverage().unobservedThroughout()), [3]);
  // On its way, a bin has no marks; its numbers are zero then.
  const volume = new page.Volume([3, 2, 2], [0, 1], 16);
  const coming = new page.Coverage(volume, null);
  assert.deepEqual(chosen(coming.unobservedIn(0)), []);
  volume.put(0, Uint16Array.of(65534, 65534, 0, 0));
  assert.deepEqual(chosen(coming.unobservedIn(0)), [2, 3]);
  assert.deepEqual(chosen(coming.unobservedThroughout()), []);
});

test("legends have numbers", () => {
  assert.equal(page.excludedText(142, 11_664), "142 pixels left out (1.2 %)");
  assert.equal(page.excludedText(1, 11_664), "1 pixel left out (below 0.1 %)");
  assert.equal(coverage().legend().text, " not observed by the frame (25.0 % of the voxels)");
  assert.equal(coverage(null).legend().text, " not observed by the frame");
});

test("a picture is hatched where nothing is observed, in colours of no map", () => {
  const bitmap = new page.Bitmap(2, 2);
  bitmap.values([0, 1, 2, 3], "magma", 0, 3);
  const before = [...bitmap.pixels];
  bitmap.hatch(coverage().unobservedIn(1));
  const after = [...bitmap.pixels];
  assert.deepEqual([after[0], after[2]], [before[0], before[2]]);
  const stripes = page.STRIPES.map(page.pack);
  assert.ok(stripes.includes(after[1]) && stripes.includes(after[3]));
  for (const map of [...page.MAPS.map(([map]) => map), "signed"]) {
    for (const colour of page.table(map)) assert.ok(!stripes.includes(colour), map);
  }
});

test("pixels that were left out are marked, large enough to be seen, and may be hidden", () => {
  let changes = 0;
  const overlay = new page.ExcludedOverlay("over-excluded-0", () => changes++);
  let drawn = [];
  const canvas = Object.assign(new Element("canvas"), { width: 200, height: 200 });
  const draw = () => {
    drawn = [];
    overlay.drawOn({ canvas, drawImage: (...all) => drawn.push(all) }, 100, 100);
  };
  // No pixel: no legend, no marks.
  overlay.set({ rows: 2, columns: 2, data: new Float32Array(4) });
  draw();
  assert.deepEqual([overlay.legend.children, drawn, changes], [[], [], 0]);

  const data = new Float32Array(400 * 400);
  data[400 + 2] = 1;
  overlay.set({ rows: 400, columns: 400, data });
  draw();
  const [[marks, ...place]] = drawn;
  assert.deepEqual(place, [0, 0, 100, 100]);
  // Two CSS pixels on a screen with two of its own for each.
  assert.deepEqual(marks.marks, [[-1, -2, 4, 4]]);
  draw();
  assert.equal(drawn[0][0], marks, "marks are drawn once for a size");
  const [box] = overlay.legend.children[0].children;
  box.checked = false;
  box.listeners.change();
  draw();
  assert.deepEqual([drawn, changes, overlay.legend.hidden], [[], 2, false]);
});

test("a saved clip has the hatching among its 256 colours", () => {
  const volume = new page.Volume([3, 2, 2], [0, 1], 8, new Uint8Array(12).fill(254));
  const state = { low: 0, high: 1, map: "magma", scale: { kind: "linear", gamma: 1 }, first: 0, last: 2, stamp: false };
  const store = { state, otherLimits: [0, 1], clock: { bins: 3 } };
  const pane = { volume, role: "main", window: () => [0, 0, 2, 2], binAt: (t) => t, subtracted: () => null };
  const clipOf = (mask) => new page.Clip(store, [{ ...pane, coverage: mask }]);
  const hatched = clipOf(coverage());
  assert.equal(hatched.palette.length, 256);
  assert.deepEqual(hatched.palette.slice(242, 244), page.STRIPES);
  assert.deepEqual(hatched.palette.slice(254), [[255, 255, 255], [0, 0, 0]]);
  const index = hatched.at(0);
  assert.equal(hatched.width, SAVED_WIDTH);
  assert.equal(index[0], 120);
  assert.ok([242, 243].includes(index[index.length - 1]));
  const plain = clipOf(null);
  assert.equal(plain.palette.length, 256);
  assert.deepEqual(new Set(plain.at(0)), new Set([120]));
});
