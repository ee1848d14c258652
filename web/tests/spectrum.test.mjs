// The frequency of a trace, without a browser: it is shown only where it stands out, as in the report.

import assert from "node:assert/strict";
import { before, test } from "node:test";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const RATE_HZ = 1e6 / 9.6;
const BINS = 54;

let spectrum;
before(async () => {
  const { outputFiles } = await build({
    entryPoints: [fileURLToPath(new URL("../src/spectrum.ts", import.meta.url))],
    bundle: true,
    write: false,
    format: "esm",
  });
  ({ spectrum } = await import(`data:text/javascript;base64,${Buffer.from(outputFiles[0].contents).toString("base64")}`));
});

const trace = (value) => Float64Array.from({ length: BINS }, (_, i) => value(i));

test("sines and square waves are found", () => {
  for (const hertz of [4600, 10000, 20833, 41000]) {
    const turns = hertz / RATE_HZ;
    const sine = spectrum(trace((i) => 3 + Math.sin(2 * Math.PI * turns * i + 0.9)), RATE_HZ);
    assert.ok(Math.abs(sine.peak_hz / hertz - 1) < 0.01, `${sine.peak_hz} for ${hertz}`);
  }
  const square = spectrum(trace((i) => (i % 10 < 5 ? 1 : 0)), RATE_HZ);
  assert.ok(Math.abs(square.peak_hz / (RATE_HZ / 10) - 1) < 0.02);
  const alternating = spectrum(trace((i) => i % 2), RATE_HZ);
  assert.ok(Math.abs(alternating.peak_hz / (RATE_HZ / 2) - 1) < 0.02);
});

test("a flash, a step, steady light and noise have none", () => {
  const flash = spectrum(trace((i) => (i === 20 ? 1 : 0)), RATE_HZ);
  assert.equal(flash.peak_hz, null);
  assert.equal(flash.isConstant, false);
  const passage = spectrum(trace((i) => Math.exp(-(((i - 27) / 6) ** 2))), RATE_HZ);
  assert.equal(passage.peak_hz, null);
  const steady = spectrum(trace(() => 5), RATE_HZ);
  assert.equal(steady.peak_hz, null);
  assert.equal(steady.isConstant, true);
  let state = 1;
  const random = () => (state = (state * 48271) % 2147483647) / 2147483647;
  for (let seed = 0; seed < 20; seed++) {
    assert.equal(spectrum(trace(() => 100 + random()), RATE_HZ).peak_hz, null);
  }
});
