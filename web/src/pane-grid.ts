// The pictures side by side, with one zoom, and the tools that are used on them.

import { choice, h } from "./dom";
import { number } from "./format";
import type { Keys } from "./keys";
import { Pane, type Role } from "./pane";
import { dragged, gripAt, type Grip, type Regions } from "./regions";
import type { Comparison, Layer, Pitch, Store, Tool } from "./store";
import type { Rect } from "./types";

interface Point {
  x: number;
  y: number;
}

/** How near to an edge of a region a press takes hold of it, in CSS pixels. */
const EDGE = 6;
const TOOLS: [Tool, string, string][] = [
  ["trace", "Region", "Click a pixel or drag a region to see its light over time; drag a region or its edge to change it (R)"],
  ["line", "Line", "Drag a line: its length, and its slice over time (D)"],
  ["probe", "Value", "The value of a pixel; arrow keys go to the next (V)"],
  ["move", "Move", "Drag the picture, or move it with the arrow keys (M)"],
];

export class PaneGrid {
  readonly element: HTMLElement;
  private readonly row: HTMLElement;
  private readonly readout: HTMLOutputElement;
  private toolButtons: HTMLButtonElement[] = [];
  panes: Pane[] = [];

  constructor(
    private readonly store: Store,
    private readonly regions: Regions,
    keys: Keys,
  ) {
    this.row = h("div", { class: "panes" });
    this.readout = h("output", { class: "readout", id: "readout" });
    this.element = h("section", { class: "stage", "aria-label": "Pictures" }, this.tools(), this.row, this.readout);
    this.setPanes();
    store.on((what) => {
      if (what === "data") for (const pane of this.panes) pane.forget();
      const isSeen = what === "probe" ? store.state.tool === "probe" : what !== "marks";
      if (isSeen) this.draw();
      this.read();
    });
    new ResizeObserver(() => this.draw()).observe(this.row);
    this.bind(keys);
    this.read();
  }

  private bind(keys: Keys): void {
    const { regions, store } = this;
    keys.add("Picture", "+  −  0", "zoom in, out, show all", {
      "+": () => this.zoom(1.5),
      "-": () => this.zoom(1 / 1.5),
      "0": () => this.zoom(0),
    });
    keys.add("Picture", "V", "show the value of a pixel; arrows go to the next, with Shift by ten", { v: () => this.choose("probe") });
    keys.add("Picture", "M", "move the picture with the arrows", { m: () => this.choose("move") });
    keys.add("Picture", "R", "a new region at that pixel, or in the middle", {
      r: () => {
        this.choose(store.state.tool === "probe" ? "probe" : "trace");
        const { y, x } = this.probed();
        regions.add(regions.about(y, x));
      },
    });
    keys.add("Picture", "D  E", "line from that pixel; to it", {
      d: () => this.lineEnd("start"),
      e: () => this.lineEnd("end"),
    });
    keys.add("Regions", "N  P", "the next region, the one before", { n: () => regions.step(1), p: () => regions.step(-1) });
    const onSelected = (act: (id: number) => void) => () => regions.selected && act(regions.selected.id);
    keys.add("Regions", "Delete", "removes the region", {
      Delete: onSelected((id) => regions.remove(id)),
      Backspace: onSelected((id) => regions.remove(id)),
    });
  }

  private choose(tool: Tool): void {
    if (tool === "probe" && !this.store.state.probe) this.store.set({ probe: this.probed() }, "probe");
    this.store.set({ tool }, "look");
    for (const b of this.toolButtons) b.setAttribute("aria-pressed", String(b.dataset.tool === tool));
    this.row.dataset.tool = tool;
    if (tool === "probe" || tool === "move") this.panes[0].canvas.focus();
  }

  /** The pixel that keys act on: the one whose value is shown, else the middle of what is seen. */
  private probed(): { y: number; x: number } {
    const { probe, cx, cy } = this.store.state;
    const { rows, columns } = this.store.video;
    const at = (v: number, size: number) => Math.min(size - 1, Math.max(0, Math.floor(v)));
    return probe ?? { y: at(cy, rows), x: at(cx, columns) };
  }

  private lineEnd(end: "start" | "end"): void {
    const { y, x } = this.probed();
    const [cx, cy] = [x + 0.5, y + 0.5];
    const { line } = this.store.state;
    this.choose(this.store.state.tool === "probe" ? "probe" : "line");
    const old = line ?? { x0: cx, y0: cy, x1: cx, y1: cy };
    this.store.set({ line: end === "start" ? { ...old, x0: cx, y0: cy } : { ...old, x1: cx, y1: cy } }, "line");
  }

  private tools(): HTMLElement {
    const { store } = this;
    const { state } = store;
    const layers: [Layer, string][] = [
      ["video", "Video"],
      ["time", "Time as colour"],
      ["peak", "Brightest over time"],
    ];
    const comparison: [Comparison, string][] = [["none", "Nothing"]];
    if (store.other) comparison.push(["other", store.source.results[1].name]);
    if (store.truth) comparison.push(["truth", "Truth"], ["difference", "Truth and difference"]);
    if (store.video.bins > 1) comparison.push(["change", "Still part and change"]);
    this.toolButtons = TOOLS.map(([name, text, title]) =>
      h(
        "button",
        { type: "button", title, "data-tool": name, "aria-pressed": String(state.tool === name), click: () => this.choose(name) },
        text,
      ),
    );
    this.row.dataset.tool = state.tool;
    return h(
      "div",
      { class: "tools" },
      h("div", { class: "segments", role: "group", "aria-label": "Tool" }, ...this.toolButtons),
      choice("Show", layers, state.layer, (layer) => store.set({ layer }, "look"), "layer"),
      comparison.length > 1 &&
        choice(
          "Compare with",
          comparison,
          state.comparison,
          (value) => {
            store.state.comparison = value;
            this.setPanes();
            store.tell("look");
          },
          "beside",
        ),
      h(
        "div",
        { class: "segments", role: "group", "aria-label": "Zoom" },
        h("button", { type: "button", "aria-label": "Zoom out", click: () => this.zoom(1 / 1.5) }, "−"),
        h("button", { type: "button", "aria-label": "Whole picture", title: "Whole picture (0)", click: () => this.zoom(0) }, "1:1"),
        h("button", { type: "button", "aria-label": "Zoom in", click: () => this.zoom(1.5) }, "+"),
      ),
    );
  }

  private setPanes(): void {
    const { store } = this;
    const { comparison } = store.state;
    const name = store.other ? store.meta.name : "Reconstruction";
    const roles: [Role, string][] = [["main", name]];
    if (comparison === "other") roles.push(["other", store.source.results[1].name]);
    if (comparison === "truth" || comparison === "difference") roles.push(["truth", "Truth"]);
    if (comparison === "difference") roles.push(["difference", "Reconstruction − truth"]);
    if (comparison === "change") roles.push(["still", "Mean over time"], ["change", "Change from the mean"]);
    this.panes = roles.map(([role, text]) => new Pane(store, role, text));
    this.row.replaceChildren(...this.panes.map((p) => p.element));
    this.row.dataset.count = String(roles.length);
    for (const pane of this.panes) {
      const { rows, columns } = pane.volume;
      pane.canvas.style.aspectRatio = `${columns} / ${rows}`;
      this.listen(pane);
    }
  }

  draw(): void {
    for (const pane of this.panes) pane.draw();
  }

  /** Says what the pixel under the pointer has, or how long the line is. */
  private read(): void {
    const { store } = this;
    const { probe, line, t } = store.state;
    const words: string[] = [];
    if (probe) {
      const { y, x } = probe;
      const values = this.panes.map((pane) => pane.valueAt(y, x, t)).filter((v) => v !== null);
      words.push(`row ${y}, column ${x}, ${store.clock.label(t)}: ${values.join(" · ")}`);
    }
    if (line) words.push(`line ${lengthOf(line, store.pitch)}`);
    this.readout.textContent = words.join(" — ") || "Row, column and value of the pixel under the pointer";
  }

  /** Zooms by a factor about a point, or the middle; 0 shows all. */
  zoom(factor: number, about?: Point): void {
    const { state, video } = this.store;
    if (factor === 0) {
      this.store.set({ zoom: 1, cx: video.columns / 2, cy: video.rows / 2 }, "look");
      return;
    }
    const zoom = Math.min(40, Math.max(1, state.zoom * factor));
    const k = state.zoom / zoom;
    const { x, y } = about ?? { x: state.cx, y: state.cy };
    this.store.set({ zoom, ...this.within(zoom, x + (state.cx - x) * k, y + (state.cy - y) * k) }, "look");
  }

  private within(zoom: number, cx: number, cy: number): { cx: number; cy: number } {
    const { columns, rows } = this.store.video;
    const [w, hgt] = [columns / zoom / 2, rows / zoom / 2];
    return {
      cx: Math.min(columns - w, Math.max(w, cx)),
      cy: Math.min(rows - hgt, Math.max(hgt, cy)),
    };
  }

  private pixel({ x, y }: Point): { y: number; x: number } {
    const { rows, columns } = this.store.video;
    const at = (v: number, size: number) => Math.min(size - 1, Math.max(0, Math.floor(v)));
    return { y: at(y, rows), x: at(x, columns) };
  }

  private rect(from: Point, to: Point): Rect {
    const [a, b] = [this.pixel(from), this.pixel(to)];
    if (a.x === b.x && a.y === b.y) return this.regions.about(a.y, a.x);
    return {
      y: Math.min(a.y, b.y),
      x: Math.min(a.x, b.x),
      rows: Math.abs(a.y - b.y) + 1,
      columns: Math.abs(a.x - b.x) + 1,
    };
  }

  /** CSS pixels of a pixel of the first video. */
  private scaleOf(pane: Pane): number {
    return pane.canvas.clientWidth / (this.store.video.columns / this.store.state.zoom);
  }

  private listen(pane: Pane): void {
    const { canvas } = pane;
    const drag = new Drag(pane, this.store, this.regions, {
      rect: (a, b) => this.rect(a, b),
      scale: () => this.scaleOf(pane),
      within: (cx, cy) => this.within(this.store.state.zoom, cx, cy),
    });
    canvas.addEventListener("pointerdown", (event) => drag.begin(event));
    canvas.addEventListener("pointermove", (event) => {
      this.store.set({ probe: this.pixel(pane.at(event)) }, "probe");
      drag.move(event);
    });
    canvas.addEventListener("pointerup", (event) => drag.end(event));
    canvas.addEventListener("pointercancel", () => {
      drag.cancel();
      this.draw();
    });
    canvas.addEventListener("pointerleave", () => {
      if (this.store.state.tool !== "probe") this.store.set({ probe: null }, "probe");
    });
    canvas.addEventListener(
      "wheel",
      (event) => {
        // Without a key the page scrolls.
        if (!event.ctrlKey && !event.shiftKey && this.store.state.zoom === 1 && event.deltaY > 0) return;
        event.preventDefault();
        this.zoom(Math.exp(-event.deltaY / 400), pane.at(event));
      },
      { passive: false },
    );
    canvas.addEventListener("dblclick", () => {
      // A double click on a part shows all; what its first click added is not meant.
      if (this.store.state.zoom > 1) drag.takeBack();
      this.zoom(0);
    });
    canvas.addEventListener("keydown", (event) => this.arrows(event));
  }

  /** Arrow keys on a picture: the pixel whose value is shown, or the part that is seen. */
  private arrows(event: KeyboardEvent): void {
    const { tool, zoom, cx, cy } = this.store.state;
    const ways: Record<string, [number, number]> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const way = ways[event.key];
    if (!way || event.ctrlKey || event.metaKey || event.altKey || (tool !== "probe" && tool !== "move")) return;
    event.preventDefault();
    const by = event.shiftKey ? 10 : 1;
    const [dx, dy] = [way[0] * by, way[1] * by];
    if (tool === "move") {
      const part = this.store.video.columns / zoom / 40;
      this.store.set(this.within(zoom, cx + dx * part, cy + dy * part), "look");
      return;
    }
    const { y, x } = this.probed();
    this.store.set({ probe: this.pixel({ x: x + dx, y: y + dy }) }, "probe");
  }
}

/** Length in pixels, and in µm where the pitch is known. */
export function lengthOf({ x0, y0, x1, y1 }: { x0: number; y0: number; x1: number; y1: number }, pitch: Pitch | null): string {
  const px = Math.hypot(x1 - x0, y1 - y0);
  return `${number(px, 4)} px${pitch ? ` · ${number(px * pitch.um, 4)} µm ${pitch.place}` : ""}`;
}

interface Geometry {
  rect: (from: Point, to: Point) => Rect;
  scale: () => number;
  within: (cx: number, cy: number) => { cx: number; cy: number };
}

/** One press on a picture, from its begin to its end. */
class Drag {
  private start: Point | null = null;
  private from = { cx: 0, cy: 0, x: 0, y: 0 };
  private grip: Grip | null = null;
  private added: number | null = null;

  constructor(
    private readonly pane: Pane,
    private readonly store: Store,
    private readonly regions: Regions,
    private readonly geometry: Geometry,
  ) {}

  begin(event: PointerEvent): void {
    if (event.button !== 0) return;
    this.pane.canvas.setPointerCapture(event.pointerId);
    this.start = this.pane.at(event);
    const { state } = this.store;
    this.from = { cx: state.cx, cy: state.cy, x: event.clientX, y: event.clientY };
    this.grip = state.tool === "trace" ? this.gripOf(this.start) : null;
    if (this.grip) this.regions.select(this.grip.region.id);
  }

  private gripOf({ x, y }: Point): Grip | null {
    return gripAt(this.store.state.regions, x, y, EDGE / this.geometry.scale());
  }

  move(event: PointerEvent): void {
    const { store, start, grip } = this;
    const now = this.pane.at(event);
    if (!start) {
      this.pane.canvas.style.cursor = store.state.tool === "trace" ? cursorOf(this.gripOf(now)) : "";
      return;
    }
    const { tool } = store.state;
    if (tool === "line") store.set({ line: { x0: start.x, y0: start.y, x1: now.x, y1: now.y } }, "look");
    if (tool === "move") {
      const k = this.geometry.scale();
      store.set(this.geometry.within(this.from.cx - (event.clientX - this.from.x) / k, this.from.cy - (event.clientY - this.from.y) / k), "look");
    }
    if (tool !== "trace") return;
    if (grip) this.regions.place(grip.region.id, dragged(grip, Math.round(now.x - start.x), Math.round(now.y - start.y)));
    else this.drawRubber(this.geometry.rect(start, now));
  }

  end(event: PointerEvent): void {
    const { store, start, grip } = this;
    if (!start) return;
    const now = this.pane.at(event);
    const { tool, regions } = store.state;
    if (tool === "trace" && !grip) {
      const region = this.regions.add(this.geometry.rect(start, now));
      this.added = region && !regions.includes(region) ? region.id : null;
    }
    if (tool === "line") {
      const long = Math.hypot(now.x - start.x, now.y - start.y) > 1;
      store.set({ line: long ? { x0: start.x, y0: start.y, x1: now.x, y1: now.y } : null }, "line");
    }
    this.cancel();
  }

  cancel(): void {
    this.start = null;
    this.grip = null;
  }

  /** Removes the region that the last click added. */
  takeBack(): void {
    if (this.added !== null) this.regions.remove(this.added);
    this.added = null;
  }

  private drawRubber(rect: Rect): void {
    this.pane.draw();
    const ctx = this.pane.canvas.getContext("2d")!;
    const [x, y, w] = this.pane.window();
    const k = this.pane.canvas.clientWidth / w;
    ctx.setLineDash([4, 3]);
    ctx.lineWidth = 1.5;
    ctx.strokeStyle = "#fff";
    ctx.strokeRect((rect.x - x) * k, (rect.y - y) * k, rect.columns * k, rect.rows * k);
    ctx.setLineDash([]);
  }
}

function cursorOf(grip: Grip | null): string {
  if (!grip) return "";
  const [across, down] = [grip.left || grip.right, grip.top || grip.bottom];
  if (across && down) return grip.left === grip.top ? "nwse-resize" : "nesw-resize";
  return across ? "ew-resize" : down ? "ns-resize" : "move";
}
