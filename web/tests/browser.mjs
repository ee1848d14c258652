// A headless Chromium and the programs that are shown in it.

import { spawn } from "node:child_process";
import { mkdtemp, readdir, readFile, writeFile, mkdir, stat } from "node:fs/promises";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after } from "node:test";
import assert from "node:assert/strict";
import pixelmatch from "pixelmatch";
import { PNG } from "pngjs";
import puppeteer from "puppeteer-core";

/** The program, and a folder with results: set by scripts/check_view. */
export const program = process.env.ROWBURST ?? "rowburst";
export const results = process.env.RESULTS ?? ".";
const golden = new URL("golden/", import.meta.url).pathname;

export async function chromium() {
  return puppeteer.launch({
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    headless: true,
    args: ["--no-sandbox", "--disable-gpu", "--force-color-profile=srgb", "--font-render-hinting=none", "--hide-scrollbars"],
  });
}

/** A page whose errors fail the test, and whose downloads land in a folder. */
export async function open(browser, url, { width = 1360, height = 1000, dark = false } = {}) {
  const page = await browser.newPage();
  await page.setViewport({ width, height });
  await page.emulateMediaFeatures([{ name: "prefers-color-scheme", value: dark ? "dark" : "light" }]);
  const faults = [];
  page.on("pageerror", (error) => faults.push(String(error)));
  page.on("console", (message) => message.type() === "error" && faults.push(message.text()));
  const folder = await mkdtemp(join(tmpdir(), "rowburst-view-"));
  const session = await browser.target().createCDPSession();
  await session.send("Browser.setDownloadBehavior", { behavior: "allow", downloadPath: folder });
  await page.goto(url);
  return { page, faults, folder };
}

// A test that fails does not stop its programs, and the file would not end before they do.
const started = [];
after(() => started.forEach((child) => child.kill("SIGKILL")));

/** Starts the program and waits for its page's address. */
export async function serve(args, where = "stdout") {
  const child = spawn(program, args, { stdio: ["ignore", "pipe", "pipe"] });
  started.push(child);
  let [out, err] = ["", ""];
  child.stdout.on("data", (data) => (out += data));
  child.stderr.on("data", (data) => (err += data));
  const found = () => (where === "stdout" ? out : err).match(/http:\/\/127\.0\.0\.1:\d+\/\?token=[0-9a-f]+/)?.[0];
  await until(() => found() || child.exitCode !== null, 20_000);
  assert.ok(found(), `no address: ${out}${err}`);
  return { url: found(), child, text: () => out + err, stop: () => child.kill("SIGINT") };
}

export async function until(test, ms = 15_000) {
  const end = Date.now() + ms;
  for (;;) {
    const value = await test();
    if (value) return value;
    assert.ok(Date.now() < end, `waited ${ms} ms for ${test}`);
    await new Promise((resolve) => setTimeout(resolve, 50));
  }
}

/** Tries `check` anew until it passes; fails as its last try did. */
export async function eventually(check, ms = 15_000) {
  const end = Date.now() + ms;
  for (;;) {
    try {
      return await check();
    } catch (error) {
      if (Date.now() >= end) throw error;
    }
    await new Promise((resolve) => setTimeout(resolve, 50));
  }
}

/** Waits until the page has drawn what it was asked for: it draws once in each frame of the browser. */
export async function drawn(page) {
  await page.evaluate(() => new Promise((resolve) => requestAnimationFrame(() => requestAnimationFrame(resolve))));
}

/** The video is there, and drawn. */
export async function loaded(page) {
  await page.waitForSelector("canvas.picture");
  await page.waitForFunction(() => document.querySelector(".scrub progress")?.hidden);
  await drawn(page);
}

/** The file that a click lets the browser keep. */
export async function download(folder, ending) {
  // A busy machine takes its time for a film.
  const name = await until(async () => (await readdir(folder)).find((n) => n.endsWith(ending)), 60_000);
  await until(async () => (await stat(join(folder, name))).size > 0);
  return readFile(join(folder, name));
}

/** A film, decoded by the browser: its size and seconds, and of some of its pictures some places. */
export function decoded(page, bytes, fps, bins, places) {
  return page.evaluate(
    async (base64, fps, bins, places) => {
      const data = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
      const film = document.createElement("video");
      film.muted = true;
      const event = (name) =>
        new Promise((resolve, reject) => {
          film.addEventListener(name, resolve, { once: true });
          film.addEventListener("error", () => reject(new Error(film.error?.message)), { once: true });
        });
      const there = event("loadeddata");
      film.src = URL.createObjectURL(new Blob([data], { type: "video/mp4" }));
      await there;
      const canvas = new OffscreenCanvas(film.videoWidth, film.videoHeight);
      const ctx = canvas.getContext("2d", { willReadFrequently: true });
      // After a seek, the film may not have its new picture yet.
      const shows = (bin) =>
        new Promise((resolve) => {
          const look = (_, { mediaTime }) => (Math.round(mediaTime * fps) === bin ? resolve() : film.requestVideoFrameCallback(look));
          film.requestVideoFrameCallback(look);
        });
      const pictures = [];
      for (const bin of bins) {
        const sought = Promise.all([event("seeked"), shows(bin)]);
        film.currentTime = (bin + 0.5) / fps;
        await sought;
        ctx.drawImage(film, 0, 0);
        pictures.push(
          places.map(({ y, x, rows, columns }) => {
            const { data } = ctx.getImageData(x, y, columns, rows);
            const luma = Array.from({ length: rows * columns }, (_, i) => data[4 * i + 1]);
            return { luma, most: Math.max(...luma), mean: luma.reduce((a, b) => a + b) / luma.length };
          }),
        );
      }
      return { width: film.videoWidth, height: film.videoHeight, seconds: film.duration, pictures };
    },
    Buffer.from(bytes).toString("base64"),
    fps,
    bins,
    places,
  );
}

/** Lets a page follow a run until its state is as wanted, and no further: later questions wait. `frozen` resolves once the page shows that state and its video. */
export async function freezeAt(page, url, isWanted) {
  let [last, tell] = [null, null];
  const frozen = new Promise((resolve) => (tell = resolve));
  await page.setRequestInterception(true);
  page.on("request", async (request) => {
    if (request.url() === new URL("api/live", url).href) {
      // Its last question is that for the state after the one that it has.
      if (last && isWanted(last)) return tell();
      // This program has no cookie of the page: it gives the token.
      const text = await (await fetch(request.url() + new URL(url).search)).text();
      last = JSON.parse(text);
      return request.respond({ contentType: "application/json", body: text });
    }
    return request.continue();
  });
  return { frozen };
}

/** Clicks pixel (y, x) of the picture. */
export async function pick(page, y, x, selector = "canvas.picture") {
  const canvas = await page.$(selector);
  const box = await canvas.boundingBox();
  const [rows, columns] = await page.evaluate(async () => (await (await fetch("api/view")).json()).results[0].shape.slice(1));
  await page.mouse.click(box.x + ((x + 0.5) / columns) * box.width, box.y + ((y + 0.5) / rows) * box.height);
}

/** Compares a picture with the stored one; UPDATE_GOLDEN=1 stores it. Fonts differ: so do some pixels. */
export async function compare(name, bytes, most = 0.08) {
  const path = join(golden, `${name}.png`);
  const actual = PNG.sync.read(Buffer.from(bytes));
  if (process.env.UPDATE_GOLDEN) {
    await mkdir(golden, { recursive: true });
    await writeFile(path, PNG.sync.write(actual, { deflateLevel: 9 }));
    return;
  }
  const wanted = PNG.sync.read(await readFile(path));
  assert.deepEqual([actual.width, actual.height], [wanted.width, wanted.height], `${name}: size`);
  const difference = new PNG({ width: actual.width, height: actual.height });
  const count = pixelmatch(actual.data, wanted.data, difference.data, actual.width, actual.height, { threshold: 0.2 });
  const part = count / (actual.width * actual.height);
  if (part > most) {
    await writeFile(join(results, `${name}-actual.png`), PNG.sync.write(actual));
    await writeFile(join(results, `${name}-difference.png`), PNG.sync.write(difference));
  }
  assert.ok(part <= most, `${name}: ${(100 * part).toFixed(2)} % of the pixels differ; see ${results}/${name}-difference.png`);
}
