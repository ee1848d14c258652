// The documentation site in a real browser, opened from the disk: SITE is its folder, set by scripts/check_site.

import assert from "node:assert/strict";
import { join } from "node:path";
import { after, before, test } from "node:test";
import { pathToFileURL } from "node:url";
import { chromium, compare, eventually, open } from "./browser.mjs";

/** Of a page, such as `search.html?q=word`. */
const address = (name) => new URL(name, pathToFileURL(join(process.env.SITE ?? "../target/docs", "index.html"))).href;
const WIDE = { width: 1280, height: 900 };
const PHONE = { width: 390, height: 844 };

let browser;
before(async () => (browser = await chromium()));
after(async () => browser?.close());

/** Shows a page; its pictures are there. */
async function shown(name, options) {
  const { page, faults } = await open(browser, address(name), options);
  await page.waitForFunction(() => [...document.images].every((image) => image.complete && image.naturalWidth > 0));
  return { page, faults };
}

test("a word is found from the disk, without a server", async () => {
  const { page, faults } = await shown("search.html?q=diffuser", WIDE);
  await page.waitForFunction(() => document.querySelectorAll("#search-results li a").length > 3);
  // They come one after another.
  await eventually(async () => {
    const titles = await page.$$eval("#search-results li a", (links) => links.map((link) => link.textContent));
    assert.ok(titles.some((title) => /diffuser/i.test(title)), titles.join(", "));
  });
  assert.deepEqual(faults, []);
  await page.close();
});

test("no page is wider than a phone", async () => {
  const { page } = await open(browser, address("index.html"), PHONE);
  const names = await page.$$eval(".sidebar-tree a.internal", (links) => links.map((link) => link.href));
  assert.ok(names.length > 30, `${names.length} pages in the menu`);
  const wide = [];
  for (const name of names) {
    await page.goto(name);
    const width = await page.evaluate(() => document.documentElement.scrollWidth);
    if (width > PHONE.width) wide.push(`${name}: ${width} px`);
  }
  assert.deepEqual(wide, []);
  await page.close();
});

const KINDS = { light: WIDE, dark: { ...WIDE, dark: true }, phone: PHONE, "phone-dark": { ...PHONE, dark: true } };
// Not those of the machine, whose widths break lines elsewhere.
const FONTS = `* { font-family: "DejaVu Sans" !important }
  :is(pre, code, kbd), :is(pre, code, kbd) * { font-family: "DejaVu Sans Mono" !important }
  math, math * { font-family: "DejaVu Serif" !important }`;
const PICTURES = { home: "index.html", method: "explanation/method.html", gallery: "gallery.html", "experiment-file": "reference/experiment-file.html" };
for (const [place, file] of Object.entries(PICTURES)) {
  for (const [kind, look] of Object.entries(KINDS)) {
    test(`${place}, ${kind}`, async () => {
      const { page, faults } = await shown(file, look);
      // A film never shows the same: its place alone is compared.
      await page.addStyleTag({ content: `${FONTS} img[src$=".gif"] { visibility: hidden }` });
      await compare(`site-${place}-${kind}`, await page.screenshot(), 0.08);
      assert.deepEqual(faults, []);
      await page.close();
    });
  }
}
