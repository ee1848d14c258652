// The page of rowburst live, over a recording that is played back.

import { after, before, test } from "node:test";
import assert from "node:assert/strict";
import { mkdir, readFile, readdir, rm, writeFile } from "node:fs/promises";
import { join } from "node:path";
import { chromium, compare, eventually, open, results, serve, until } from "./browser.mjs";

let browser;
before(async () => (browser = await chromium()));
after(() => browser?.close());

/** Stores `count` times the frame of the demo as 16-bit counts, each a little brighter than the one before. */
async function recording(path, count) {
  const bytes = await readFile(join(results, "leds", "frame.npy"));
  const header = bytes.readUInt16LE(8);
  const [rows, columns] = bytes.toString("latin1", 10, 10 + header).match(/\((\d+), (\d+)/).slice(1).map(Number);
  const frame = new Float32Array(rows * columns);
  for (let i = 0; i < frame.length; i++) frame[i] = bytes.readFloatLE(10 + header + 4 * i);
  const most = frame.reduce((a, b) => Math.max(a, b));
  const counts = new Uint16Array(count * frame.length);
  for (let t = 0; t < count; t++) {
    for (let i = 0; i < frame.length; i++) {
      counts[t * frame.length + i] = Math.max(0, Math.round((frame[i] / most) * (40000 + 100 * t)));
    }
  }
  const words = `{'descr': '<u2', 'fortran_order': False, 'shape': (${count}, ${rows}, ${columns}), }`.padEnd(117) + "\n";
  const head = Buffer.from(`\x93NUMPY\x01\x00\x00\x00${words}`, "latin1");
  head.writeUInt16LE(words.length, 8);
  await writeFile(path, Buffer.concat([head, Buffer.from(counts.buffer)]));
}

test("a camera is looked at, recorded, and its frame reconstructed in full", async () => {
  const folder = join(results, "live");
  await rm(folder, { recursive: true, force: true });
  await mkdir(folder);
  await recording(join(folder, "frames.npy"), 8);
  const experiment = join(results, "leds", "experiment.toml");
  const live = await serve(
    ["live", experiment, "--source", `play:${join(folder, "frames.npy")}?rate=15&loop`, "--time-budget-s", "0.3", "--port", "0", "--no-open", "-o", join(folder, "kept")],
    "stdout",
  );
  const { page, faults } = await open(browser, live.url);
  await page.waitForSelector("#monitor-numbers");
  const numbers = () => page.$eval("#monitor-numbers", (e) => e.innerText);
  await until(async () => /Latency\s+[\d.]+ ms[^]*Videos a second\s+[\d.]/.test(await numbers()), 30_000);
  assert.match(await numbers(), /Saturated\s+0 %[^]*Speckle contrast\s+[\d.]+[^]*Grain\s+[\d.]+ px[^]*Latency\s+[\d.]+ ms/);
  const colours = (selector) =>
    page.$eval(selector, (c) => new Set(new Uint32Array(c.getContext("2d").getImageData(0, 0, c.width, c.height).data.buffer)).size);
  await eventually(async () => assert.ok((await colours("#raw-frame")) > 50, "the raw frame is drawn"));
  await eventually(async () => assert.ok((await colours("canvas.picture")) > 10, "the video is drawn"));
  await page.click("#record");
  // A busy machine may show no number below ten.
  await until(async () => Number((await page.$eval("#record", (e) => e.textContent)).match(/Stop \((\d+) frames\)/)?.[1]) >= 3);
  await page.click("#record");
  const message = () => page.$eval("#monitor-message", (e) => e.textContent);
  await until(async () => /kept \d+ frames in recording\.tif/.test(await message()));
  await page.click("#snapshot");
  await until(async () => /kept .*frame-\d+\.tif/.test(await message()));
  await page.click("#save-full");
  await until(async () => /the result is in/.test(await message()), 60_000);
  await page.screenshot({ path: join(folder, "live.png") });
  const kept = await readdir(join(folder, "kept"));
  const record = JSON.parse(await readFile(join(folder, "kept", "recording.json"), "utf8"));
  assert.ok(record.written >= 3 && record.frames.length === record.written, `${kept}`);
  const result = kept.find((name) => /^frame-\d+(-2)?$/.test(name));
  assert.ok((await readdir(join(folder, "kept", result))).includes("result.json"), `${kept}`);
  assert.deepEqual(faults, []);
  live.stop();
  await until(() => live.child.exitCode !== null);
  assert.equal(live.child.exitCode, 130);
  await page.close();
});

/** Serves the state of the page as `change` makes it, and takes note of what the page sends. */
async function changeState(page, url, change) {
  const sent = [];
  await page.setRequestInterception(true);
  page.on("request", async (request) => {
    const path = new URL(request.url()).pathname;
    if (request.method() === "POST") {
      sent.push(decodeURIComponent(path));
      return request.respond({ status: 204 });
    }
    if (path !== "/api/monitor") return request.continue();
    const answer = await fetch(request.url() + new URL(url).search).catch(() => null);
    // The program has been stopped, and the page is about to be closed.
    if (!answer) return request.abort();
    return request.respond({ contentType: "application/json", body: JSON.stringify(change(await answer.json())) });
  });
  return sent;
}

test("exposure and gain are set where the camera offers them", async () => {
  const live = await serve(["live", "--source", `play:${join(results, "live", "frames.npy")}?rate=15&loop`, "--port", "0", "--no-open"], "stdout");
  const { page, faults } = await open(browser, live.url);
  await page.waitForSelector("#raw-frame");
  // A recording has nothing to set.
  await until(async () => /Frame\s+\d/.test(await page.$eval("#monitor-numbers", (e) => e.innerText)));
  assert.equal((await page.$$("#monitor-controls input")).length, 0);
  const controls = [
    { name: "ExposureTime", value: 100, min: 10, max: 100000, unit: "us" },
    { name: "Gain", value: 2, min: 0, max: 10, unit: null },
  ];
  const sent = await changeState(page, live.url, (state) => ({ ...state, controls }));
  await page.waitForSelector("#monitor-controls input");
  const texts = () => page.$$eval("#monitor-controls .control", (list) => list.map((e) => e.innerText.replace(/\s+/g, " ")));
  assert.deepEqual(await texts(), ["ExposureTime 100 µs", "Gain 2"]);
  // A wide range is logarithmic: a tenth of the exposure is a quarter of the slider.
  assert.deepEqual(await page.$$eval("#monitor-controls input", (list) => list.map((e) => e.value)), ["250", "200"]);
  await page.$eval("#monitor-controls input", (e) => {
    e.value = "500";
    e.dispatchEvent(new Event("input"));
    e.dispatchEvent(new Event("change"));
  });
  await until(() => sent.length === 1);
  assert.match(sent[0], /^\/api\/monitor\/set\/ExposureTime\/1000(\.0*)?$|999\.9/);
  assert.deepEqual(faults, []);
  live.stop();
  await page.close();
});

for (const [name, dark] of [["live-light", false], ["live-dark", true]]) {
  test(`the page of a camera looks as it did: ${name}`, async () => {
    // One frame that stays, so that its video settles.
    const folder = join(results, "live");
    await recording(join(folder, "one.npy"), 1);
    const experiment = join(results, "leds", "experiment.toml");
    const source = `play:${join(folder, "one.npy")}`;
    const live = await serve(["live", experiment, "--source", source, "--time-budget-s", "20", "--port", "0", "--no-open", "-o", join(folder, name)], "stdout");
    const { page, faults } = await open(browser, live.url, { width: 1280, dark });
    await page.waitForSelector("#monitor-message");
    await until(async () => /no more frames/.test(await page.$eval("#monitor-message", (e) => e.textContent)));
    const still = (state) => ({
      ...state,
      frames_per_second: 15,
      video: state.video && { ...state.video, videos_per_second: 11.4, residual_over_sigma: 1.02 },
      controls: [
        { name: "ExposureTime", value: 100, min: 10, max: 100000, unit: "us" },
        { name: "Gain", value: 2, min: 0, max: 10, unit: null },
      ],
    });
    await until(async () => /Videos a second|Latency/.test(await page.$eval("#monitor-numbers", (e) => e.innerText)), 60_000);
    await changeState(page, live.url, still);
    await page.waitForSelector("#monitor-controls input");
    // The latency, which differs from run to run. The page's own policy lets no style element in.
    await page.evaluate(() => {
      const sheet = new CSSStyleSheet();
      sheet.replaceSync('#latency { font-size: 0 } #latency::after { content: "84 ms"; font-size: 15px }');
      document.adoptedStyleSheets = [sheet];
    });
    // The path of the folder, which differs from machine to machine.
    await page.evaluate((source) => {
      const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
      while (walk.nextNode()) walk.currentNode.data = walk.currentNode.data.replaceAll(source, "play:one.npy");
    }, source);
    await eventually(async () => compare(name, await page.screenshot()));
    assert.deepEqual(faults, []);
    live.stop();
    await page.close();
  });
}

test("without an experiment the raw frame is shown", async () => {
  const live = await serve(["live", "--source", `play:${join(results, "live", "frames.npy")}?rate=15`, "--port", "0", "--no-open"], "stdout");
  const { page, faults } = await open(browser, live.url);
  await page.waitForSelector("#raw-frame");
  await until(async () => /no more frames/.test(await page.$eval("#monitor-message", (e) => e.textContent)));
  assert.equal(await page.$eval("#save-full", (e) => e.disabled), true);
  assert.match(await page.$eval("#monitor-warnings", (e) => e.textContent), /row time is not known/);
  assert.deepEqual(faults, []);
  live.stop();
  await page.close();
});
