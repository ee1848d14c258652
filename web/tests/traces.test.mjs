// When the traces are drawn, without a browser.

import assert from "node:assert/strict";
import { before, test } from "node:test";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

let page;
before(async () => {
  const { outputFiles } = await build({
    stdin: {
      contents: ["traces", "volume"].map((name) => `export * from "./${name}";`).join("\n"),
      resolveDir: fileURLToPath(new URL("../src", import.meta.url)),
    },
    bundle: true,
    write: false,
    format: "esm",
    loader: { ".css": "empty" },
  });
  page = await import(`data:text/javascript;base64,${Buffer.from(outputFiles[0].contents).toString("base64")}`);
});

test("a truth that comes after the video is drawn", (context) => {
  const waiting = [];
  context.mock.method(globalThis, "setTimeout", (call) => waiting.push(call));
  const volume = () => new page.Volume([2, 1, 1], [0, 1], 16);
  const store = { video: volume(), truth: volume(), other: null };
  const bins = new Uint16Array(2);
  const traces = Object.create(page.Traces.prototype);
  let drawn = 0;
  Object.assign(traces, {
    store,
    pending: false,
    draw() {
      drawn += 1;
      this.drawnBins = this.loadedBins;
    },
  });
  const timesDrawn = () => {
    traces.later();
    waiting.splice(0).forEach((call) => call());
    return drawn;
  };
  store.video.put(0, bins);
  assert.equal(timesDrawn(), 1);
  assert.equal(timesDrawn(), 1, "nothing is new");
  store.truth.put(0, bins.subarray(1));
  assert.equal(timesDrawn(), 2);
  store.truth.put(1, bins.subarray(1));
  assert.equal(timesDrawn(), 3);
  assert.equal(timesDrawn(), 3, "nothing is new");
});
