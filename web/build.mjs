// Bundles the page into a folder: one script, one style sheet, the page that names them, and the licences of the
// packages that the script holds.
import { build } from "esbuild";
import { copyFile, mkdir, readdir, readFile, writeFile } from "node:fs/promises";

const folder = process.argv[2];
await mkdir(folder, { recursive: true });
const { metafile } = await build({
  entryPoints: [{ in: "src/main.ts", out: "app" }],
  bundle: true,
  minify: true,
  format: "iife",
  charset: "utf8",
  target: ["es2022"],
  legalComments: "eof",
  outdir: folder,
  logLevel: "warning",
  metafile: true,
});
await copyFile("src/index.html", `${folder}/index.html`);

const bundled = Object.keys(metafile.inputs).map((path) => path.match(/^node_modules\/((?:@[^/]+\/)?[^/]+)/)?.[1]);
const packages = [...new Set(bundled.filter(Boolean))].sort();
const licences = await Promise.all(
  packages.map(async (name) => {
    const { version, license, repository } = JSON.parse(await readFile(`node_modules/${name}/package.json`, "utf8"));
    const file = (await readdir(`node_modules/${name}`)).find((entry) => /^licen[cs]e/i.test(entry));
    if (!file) throw new Error(`${name} has no file with its licence`);
    const text = (await readFile(`node_modules/${name}/${file}`, "utf8")).replaceAll("\r\n", "\n").trim();
    return `${name} ${version}, ${license}, ${repository.url ?? repository}\n\n${text}\n`;
  }),
);
await writeFile(`${folder}/LICENCES.txt`, licences.join(`\n${"-".repeat(80)}\n\n`));
