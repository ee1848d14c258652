// Regions of ImageJ, the paths of play, ticks and comparisons, without a browser.

import assert from "node:assert/strict";
import { before, test } from "node:test";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

let page;
before(async () => {
  const files = ["axis", "colour", "colour-bar", "compare", "keys", "regions", "roi", "slices", "transport"];
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

/** A header and a second header with the name, as roifile 2026 (Python) writes them. */
const written = (start, name) => {
  const tail = Buffer.from(name, "utf16le").swap16();
  const bytes = Buffer.alloc(128 + tail.length);
  Buffer.from(start, "hex").copy(bytes);
  bytes.writeInt32BE(64, 60);
  bytes.writeInt32BE(128, 80);
  bytes.writeInt32BE(name.length, 84);
  tail.copy(bytes, 128);
  return new Uint8Array(bytes);
};

test("rectangles and lines of ImageJ are read, other forms as their boxes", () => {
  const rect = written("496f757400e40100000700050013000e", "spot é");
  assert.deepEqual(page.decodeRois(rect, "a.roi"), [{ name: "spot é", rect: { y: 7, x: 5, rows: 12, columns: 9 }, line: null, isBox: false }]);
  const line = written("496f757400e40300000200010028001e00003fc000004020000041f000004221", "cut");
  const [cut] = page.decodeRois(line, "b.roi");
  assert.deepEqual(cut.line, { x0: 1.5, y0: 2.5, x1: 30, y1: 40.25 });
  const [round] = page.decodeRois(written("496f757400e40200000300040009000c", "round"), "c.roi");
  assert.deepEqual([round.rect, round.isBox], [{ y: 3, x: 4, rows: 6, columns: 8 }, true]);
});

test("what is written has the bytes that others write, and comes back", () => {
  const roi = { name: "spot é", rect: { y: 7, x: 5, rows: 12, columns: 9 }, line: null, isBox: false };
  assert.deepEqual(page.encodeRoi(roi), written("496f757400e40100000700050013000e", "spot é"));
  const rois = [roi, { ...roi, name: "a/b" }, { ...roi, name: "a/b" }, { name: "cut", rect: null, line: { x0: 1, y0: 2, x1: 3, y1: 4.5 }, isBox: false }];
  const zip = page.encodeRois(rois);
  assert.deepEqual([zip[0], zip[1]], [0x50, 0x4b]);
  assert.deepEqual(page.decodeRois(zip, "set.zip"), rois);
});

test("files that are no regions are refused with their name", () => {
  for (const bytes of [new Uint8Array(), new Uint8Array(64), new TextEncoder().encode("time_us,value\n".repeat(9))]) {
    assert.throws(() => page.decodeRois(bytes, "bad.roi"), /bad\.roi/);
  }
  const whole = page.encodeRois([{ name: "a", rect: { y: 1, x: 1, rows: 2, columns: 2 }, line: null, isBox: false }]);
  assert.throws(() => page.decodeRois(whole.slice(0, 60), "cut.zip"));
  // Any bytes give regions or an error, and no region without pixels.
  const rect = written("496f757400e40100000700050013000e", "spot");
  for (let i = 0; i < rect.length; i++) {
    for (const value of [0, 127, 255]) {
      const changed = rect.slice();
      changed[i] = value;
      try {
        for (const { rect: r } of page.decodeRois(changed, "x.roi")) assert.ok(!r || (r.rows > 0 && r.columns > 0));
      } catch (error) {
        assert.match(error.message, /x\.roi/);
      }
    }
  }
});

test("play goes once, again and again, or to and fro, within its part", () => {
  const path = (repeat, steps, by = 1) => {
    let [t, direction] = [2, 1];
    const seen = [];
    for (let i = 0; i < steps; i++) {
      const next = page.after({ t, first: 2, last: 5, repeat }, direction, by);
      [t, direction] = [next.t, next.direction];
      seen.push(t);
      if (next.isEnd) break;
    }
    return seen;
  };
  assert.deepEqual(path("once", 9), [3, 4, 5, 5]);
  assert.deepEqual(path("loop", 6), [3, 4, 5, 2, 3, 4]);
  assert.deepEqual(path("ping-pong", 8), [3, 4, 5, 4, 3, 2, 3, 4]);
  assert.deepEqual(path("loop", 3, 2), [4, 2, 4]);
  assert.deepEqual(page.after({ t: 3, first: 3, last: 3, repeat: "ping-pong" }, 1, 4), { t: 3, direction: 1, isEnd: false });
});

test("a slope is a speed where pitch and time are known", () => {
  const slope = { t0: 2, p0: 10, t1: 12, p1: 35 };
  assert.equal(page.speedOf(slope, 10, { um: 6.5, place: "at the sensor" }), "2.5 px per bin · 1.625 m/s at the sensor");
  assert.equal(page.speedOf(slope, 10, { um: 13, place: "at the object" }), "2.5 px per bin · 3.25 m/s at the object");
  assert.equal(page.speedOf(slope, 10, null), "2.5 px per bin · 0.25 px/µs");
  assert.equal(page.speedOf(slope, null, 6.5), "2.5 px per bin");
  assert.equal(page.speedOf({ ...slope, t1: 2 }, 10, 6.5), "no time passes along the line");
});

test("ticks are round, and a colour bar takes a power of ten out of its numbers", () => {
  assert.deepEqual(page.ticks(0, 518.4, 5), [0, 200, 400]);
  assert.deepEqual(page.ticks(0, 518.4, 6), [0, 100, 200, 300, 400, 500]);
  assert.deepEqual(page.ticks(3, 3, 4), [3]);
  const bar = { map: "magma", scale: { kind: "linear", gamma: 1 }, low: 0, high: 1.18e7, unit: "counts" };
  assert.equal(page.barTicks(bar, 4).exponent, 7);
  assert.deepEqual(page.barTicks({ ...bar, high: 1, scale: { kind: "log", gamma: 1 } }, 4).values, [1, 0.1, 0.01, 0.001]);
});

test("scales go from 0 to 1, and all maps grow in lightness", () => {
  for (const kind of ["linear", "gamma", "log"]) {
    const scale = { kind, gamma: 0.5 };
    const shades = [-1, 0, 0.01, 0.1, 0.5, 1, 2].map((f) => page.shadeOf(f, scale));
    assert.deepEqual([shades[0], shades[1], shades.at(-2), shades.at(-1)], [0, 0, 1, 1]);
    assert.ok(shades.every((s, i) => i === 0 || s >= shades[i - 1]), `${kind}: ${shades}`);
  }
  assert.equal(page.shadeOf(0.25, { kind: "gamma", gamma: 0.5 }), 0.5);
  assert.ok(Math.abs(page.shadeOf(0.1, { kind: "log", gamma: 1 }) - 2 / 3) < 1e-12);
  const light = ([r, g, b]) => 0.2126 * r ** 2.2 + 0.7152 * g ** 2.2 + 0.0722 * b ** 2.2;
  for (const [map] of page.MAPS) {
    for (let i = 1; i <= 20; i++) assert.ok(light(page.colourOf(map, i / 20)) >= light(page.colourOf(map, (i - 1) / 20)), `${map} ${i}`);
  }
});

test("a region is held at its edges and within, and is dragged by them", () => {
  const region = { id: 1, y: 20, x: 30, rows: 10, columns: 8 };
  const grip = (x, y) => page.gripAt([region], x, y, 2);
  assert.equal(grip(50, 50), null);
  const middle = grip(34, 25);
  assert.deepEqual([middle.top, middle.bottom, middle.left, middle.right], [false, false, false, false]);
  assert.deepEqual(page.dragged(middle, 3, -2), { y: 18, x: 33, rows: 10, columns: 8 });
  const corner = grip(37.5, 29.5);
  assert.deepEqual(page.dragged(corner, 2, 1), { y: 20, x: 30, rows: 11, columns: 10 });
  assert.deepEqual(page.dragged(corner, -50, -50), { y: 20, x: 30, rows: 1, columns: 1 });
});

test("settings are compared row by row", () => {
  assert.deepEqual(page.rowsOf([["prior", "tv"], ["τ", "1"]], [["prior", "tv"], ["σ", "2"]]), [
    { name: "prior", values: ["tv", "tv"], differs: false },
    { name: "τ", values: ["1", "–"], differs: true },
    { name: "σ", values: ["–", "2"], differs: true },
  ]);
});
