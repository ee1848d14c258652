// Time, lengths and values in words, without a browser.

import assert from "node:assert/strict";
import { before, test } from "node:test";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

let Clock, Store;
before(async () => {
  const { outputFiles } = await build({
    stdin: {
      contents: 'export { Clock } from "./format"; export { Store } from "./store";',
      resolveDir: fileURLToPath(new URL("../src", import.meta.url)),
    },
    bundle: true,
    write: false,
    format: "esm",
  });
  ({ Clock, Store } = await import(`data:text/javascript;base64,${Buffer.from(outputFiles[0].contents).toString("base64")}`));
});

/** A store of which only the axes are used. */
function store(view, bins = 4) {
  const meta = { view, shape: [bins, 2, 2], bin_duration_us: 9.6 };
  return Object.assign(Object.create(Store.prototype), { meta, clock: new Clock(bins, 9.6, view?.start_us) });
}

test("the clock counts from the start of the first exposure", () => {
  const clock = new Clock(4, 9.6, -4.8);
  assert.equal(clock.at(0), 0);
  assert.equal(clock.label(1), "9.6 µs");
  assert.equal(clock.bin(9.6), 1);
  assert.equal(clock.bin(-100), 0);
  assert.deepEqual([clock.start, clock.end].map((t) => Number(t.toFixed(6))), [-4.8, 33.6]);
  // A range of bins, and a result of 0.1.
  assert.equal(new Clock(4, 10, 40).at(0), 45);
  assert.equal(new Clock(4, 9.6, undefined).at(0), 4.8);
  assert.equal(new Clock(4, null, 40).at(0), 0.5);
});

test("lengths are at the object where the magnification is known", () => {
  assert.equal(store({}).pitch, null);
  assert.deepEqual(store({ pixel_pitch_um: 6.5 }).pitch, { um: 6.5, place: "at the sensor" });
  assert.deepEqual(store({ pixel_pitch_um: 6.5, magnification: 0.5 }).pitch, { um: 13, place: "at the object" });
});

test("light is in counts, and in electrons where the gain is known", () => {
  assert.equal(store({}).valueWords(200), "200 counts");
  assert.equal(store({ gain_electrons_per_count: 0.45 }).valueWords(200), "200 counts (90 electrons)");
  assert.equal(store({ unit: "volts", gain_electrons_per_count: 0.45 }).valueWords(2), "2 volts");
});

test("zero and counts are explained", () => {
  assert.equal(store({}).axesWords, "");
  const zero = "t = 0 is the start of exposure of the row that is read first";
  assert.ok(store({ start_us: 0 }).axesWords.startsWith(`${zero}. Light is in counts: those`));
  const all = store({ start_us: 0, trigger_delay_us: 12.3, gain_electrons_per_count: 0.45 }).axesWords;
  assert.ok(all.startsWith(`${zero}, 12.3 µs after the trigger. Light is in counts (1 count is 0.45 electrons): those`), all);
});
