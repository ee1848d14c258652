// The page: opens a result, puts the parts together.

import "uplot/dist/uPlot.min.css";
import "./app.css";
import { between } from "./between";
import { Cloud } from "./cloud";
import { compare } from "./compare";
import { h } from "./dom";
import { Evidence, settings } from "./evidence";
import { Help } from "./help";
import { Keys } from "./keys";
import { Limits } from "./limits";
import { Live } from "./live";
import { Monitor } from "./monitor";
import { Save } from "./save";
import { Slices } from "./slices";
import { openSource, report, type Source } from "./source";
import { PaneGrid } from "./pane-grid";
import { Regions } from "./regions";
import { Store } from "./store";
import { Traces } from "./traces";
import { Transport } from "./transport";
import { Volume } from "./volume";

async function start(): Promise<void> {
  const root = document.getElementById("rowburst")!;
  root.replaceChildren(
    h("p", { id: "rowburst-error", class: "error", role: "alert", hidden: true }),
    h("p", { id: "rowburst-status", class: "unseen", role: "status" }),
    h("p", { id: "rowburst-notice", role: "status", hidden: true }),
  );
  try {
    build(root, await openSource());
  } catch (error) {
    report(error);
  }
}

function build(root: HTMLElement, source: Source): void {
  const began = performance.now();
  const [meta, second] = source.results;
  let store: Store | null = null;
  const wanted = () => store?.state.t ?? 0;
  let first = true;
  const loaded = () => {
    store?.tell("data");
    if (first) performance.measure("first bins", { start: began });
    first = false;
  };
  const empty = () => new Volume(meta.shape, [0, 1], 16);
  const video = source.volume(0, "video", wanted, loaded) ?? empty();
  const truth = source.volume(0, "truth", wanted, loaded);
  const otherWanted = () => store?.otherBinAt(wanted()) ?? 0;
  const other = second ? source.volume(1, "video", otherWanted, loaded) : null;
  const coverage = source.volume(0, "coverage", wanted, loaded);
  const otherCoverage = second ? source.volume(1, "coverage", otherWanted, loaded) : null;
  store = new Store(source, { video, truth, other }, { coverage, otherCoverage });

  const keys = new Keys();
  const regions = new Regions(store);
  const transport = new Transport(store, keys);
  const paneGrid = new PaneGrid(store, regions, keys);
  const limits = new Limits(store, keys);
  const save = new Save(store, paneGrid, keys);
  const traces = new Traces(store, regions);
  const tabs = source.live ? watch(store) : panel(store, traces, keys);
  const help = new Help(keys);
  if (!source.isOffline) document.title = `${second ? `${meta.name} and ${second.name}` : meta.name} – Rowburst`;
  if (!source.isOffline) root.append(header(source));
  root.append(
    h(
      "div",
      { class: "page" },
      h("div", { class: "left" }, paneGrid.element, between(store), transport.element, limits.element, save.element),
      tabs,
    ),
    h("p", { class: "keys" }, help.button),
    help.dialog,
  );
  keys.note("Regions", "←  →  ↑  ↓", "on a region of the list: moves it; with Shift its size");
  keys.note("Regions", "Enter", "on a region of the list: its name");
  keys.listen();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => store.tell("look"));
  traces.begin();
  store.tell("data");
  store.tell("regions");
}

function header(source: Source): HTMLElement {
  const [meta, second] = source.results;
  const title = second ? `${meta.name} and ${second.name}` : meta.name;
  const fit = meta.view?.fit;
  const numbers = (meta.view?.headline ?? []).filter(([name]) => name !== "Fit");
  return h(
    "header",
    {},
    h("h1", { title: meta.view?.title }, title),
    fit && !second && h("span", { class: fit.verdict === "good" ? "pill" : "pill doubtful", title: fit.reason }, `fit: ${fit.verdict}`),
    source.live && h("span", { class: "pill" }, source.isMonitor ? "live" : "running"),
    !second && numbers.length > 0 && h("dl", {}, ...numbers.map(([n, v]) => h("div", {}, h("dt", {}, n), h("dd", {}, v)))),
  );
}

/** The parts at the right, one at a time. */
function panel(store: Store, traces: Traces, keys: Keys): HTMLElement {
  const slices = new Slices(store, keys);
  const cloud = new Cloud(store);
  const evidence = new Evidence(store);
  const parts: [string, string, HTMLElement, () => void][] = [
    ["traces", "Traces", traces.element, () => store.tell("regions")],
    [
      "space-time",
      "Space–time",
      h("div", {}, slices.element, cloud.element),
      () => {
        slices.draw();
        cloud.draw();
      },
    ],
    ["evidence", "Evidence", evidence.element, () => evidence.draw()],
    ["settings", "Settings", settings(store), () => undefined],
  ];
  const comparison = compare(store);
  if (comparison) parts.splice(3, 0, ["compare", "Compare", comparison, () => undefined]);
  // One picture has no time to look at.
  if (store.clock.bins === 1) parts.splice(1, 1);
  const tabs: HTMLButtonElement[] = [];
  const panels: HTMLElement[] = [];
  const choose = (at: number) => {
    tabs.forEach((tab, i) => {
      tab.setAttribute("aria-selected", String(i === at));
      tab.tabIndex = i === at ? 0 : -1;
      panels[i].hidden = i !== at;
    });
    parts[at][3]();
  };
  keys.add("Page", "T", "the next panel", {
    t: () => {
      const next = (tabs.findIndex((tab) => tab.tabIndex === 0) + 1) % tabs.length;
      choose(next);
      tabs[next].focus();
    },
  });
  parts.forEach(([id, name, element], i) => {
    tabs.push(
      h("button", { type: "button", role: "tab", id: `tab-${id}`, "aria-controls": `panel-${id}`, click: () => choose(i) }, name),
    );
    panels.push(h("div", { role: "tabpanel", id: `panel-${id}`, "aria-labelledby": `tab-${id}` }, element));
  });
  const list = h("div", { class: "tabs", role: "tablist", "aria-label": "Panels" }, ...tabs);
  list.addEventListener("keydown", (event) => {
    const by = event.key === "ArrowRight" ? 1 : event.key === "ArrowLeft" ? -1 : 0;
    if (!by) return;
    event.preventDefault();
    const now = tabs.indexOf(document.activeElement as HTMLButtonElement);
    const next = (now + by + tabs.length) % tabs.length;
    choose(next);
    tabs[next].focus();
  });
  choose(0);
  return h("div", { class: "right" }, list, ...panels);
}

function watch(store: Store): HTMLElement {
  return h("div", { class: "right" }, (store.source.isMonitor ? new Monitor(store) : new Live(store)).element);
}

void start();
