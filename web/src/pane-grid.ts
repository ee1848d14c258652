// The pictures side by side, with one zoom, and the tools that are used on them.

import { REGION_COLOURS } from "./colour";
import { choice, h } from "./dom";
import { Pane, type Role } from "./pane";
import type { Comparison, Layer, Region, Store, Tool } from "./store";
import type { Rect } from "./types";

/** Side of the region that a click picks, as that of `--region Y,X`. */
const SIDE = 3;

export class PaneGrid {
  readonly element: HTMLElement;
  private readonly row: HTMLElement;
  panes: Pane[] = [];
  private nextId = 1;

  constructor(private readonly store: Store) {
    this.row = h("div", { class: "panes" });
    this.element = h("section", { class: "stage", "aria-label": "Pictures" }, this.tools(), this.row);
    this.setPanes();
    store.on((what) => {
      if (what === "data") for (const pane of this.panes) pane.forget();
      this.draw();
    });
    new ResizeObserver(() => this.draw()).observe(this.row);
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
    const tools: [Tool, string, string][] = [
      ["trace", "Region", "Click a pixel or drag a region to see its light over time"],
      ["line", "Line", "Drag a line to see it over time"],
      ["move", "Move", "Drag the picture"],
    ];
    const toolButtons = tools.map(([name, text, title]) =>
      h(
        "button",
        {
          type: "button",
          title,
          "data-tool": name,
          "aria-pressed": String(state.tool === name),
          click: () => {
            store.set({ tool: name }, "look");
            for (const b of toolButtons) b.setAttribute("aria-pressed", String(b.dataset.tool === name));
            this.row.dataset.tool = name;
          },
        },
        text,
      ),
    );
    this.row.dataset.tool = state.tool;
    return h(
      "div",
      { class: "tools" },
      h("div", { class: "segments", role: "group", "aria-label": "Tool" }, ...toolButtons),
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

  /** Zooms by a factor about a point, or the middle; 0 shows all. */
  zoom(factor: number, about?: { x: number; y: number }): void {
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

  /** Adds a region; the oldest goes where there are more than colours. */
  add(rect: Rect): void {
    const regions = [...this.store.state.regions];
    const used = new Set(regions.map((r) => r.colour));
    if (regions.length === REGION_COLOURS.length) used.delete(regions.shift()!.colour);
    const colour = REGION_COLOURS.find((c) => !used.has(c))!;
    const region: Region = { ...rect, id: this.nextId++, colour };
    this.store.set({ regions: [...regions, region] }, "regions");
  }

  private rect(a: { x: number; y: number }, b: { x: number; y: number }): Rect {
    const { rows, columns } = this.store.video;
    const at = (v: number, size: number) => Math.min(size - 1, Math.max(0, Math.floor(v)));
    const [xa, xb] = [at(a.x, columns), at(b.x, columns)];
    const [ya, yb] = [at(a.y, rows), at(b.y, rows)];
    if (Math.abs(xa - xb) < 1 && Math.abs(ya - yb) < 1) {
      // About the pixel, cut off at the edges.
      const from = (v: number) => Math.max(0, v - (SIDE >> 1));
      const to = (v: number, size: number) => Math.min(size, v + (SIDE >> 1) + 1);
      return { y: from(ya), x: from(xa), rows: to(ya, rows) - from(ya), columns: to(xa, columns) - from(xa) };
    }
    return {
      y: Math.min(ya, yb),
      x: Math.min(xa, xb),
      rows: Math.abs(ya - yb) + 1,
      columns: Math.abs(xa - xb) + 1,
    };
  }

  private listen(pane: Pane): void {
    const { store } = this;
    const { canvas } = pane;
    let start: { x: number; y: number } | null = null;
    let from = { cx: 0, cy: 0, x: 0, y: 0 };
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      canvas.setPointerCapture(event.pointerId);
      start = pane.at(event);
      from = { cx: store.state.cx, cy: store.state.cy, x: event.clientX, y: event.clientY };
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!start) return;
      const now = pane.at(event);
      const { tool } = store.state;
      if (tool === "line") store.set({ line: { x0: start.x, y0: start.y, x1: now.x, y1: now.y } }, "look");
      if (tool === "move") {
        const k = canvas.clientWidth / (store.video.columns / store.state.zoom);
        const [cx, cy] = [from.cx - (event.clientX - from.x) / k, from.cy - (event.clientY - from.y) / k];
        store.set(this.within(store.state.zoom, cx, cy), "look");
      }
      if (tool === "trace") this.drawRubber(pane, this.rect(start, now));
    });
    canvas.addEventListener("pointerup", (event) => {
      if (!start) return;
      const now = pane.at(event);
      const { tool } = store.state;
      if (tool === "trace") this.add(this.rect(start, now));
      if (tool === "line") {
        const long = Math.hypot(now.x - start.x, now.y - start.y) > 1;
        store.set({ line: long ? { x0: start.x, y0: start.y, x1: now.x, y1: now.y } : null }, "line");
      }
      start = null;
    });
    canvas.addEventListener("pointercancel", () => {
      start = null;
      this.draw();
    });
    canvas.addEventListener(
      "wheel",
      (event) => {
        // Without a key the page scrolls.
        if (!event.ctrlKey && !event.shiftKey && store.state.zoom === 1 && event.deltaY > 0) return;
        event.preventDefault();
        this.zoom(Math.exp(-event.deltaY / 400), pane.at(event));
      },
      { passive: false },
    );
    canvas.addEventListener("dblclick", () => this.zoom(0));
  }

  private drawRubber(pane: Pane, rect: Rect): void {
    pane.draw();
    const ctx = pane.canvas.getContext("2d")!;
    const [x, y, w] = pane.window();
    const k = pane.canvas.clientWidth / w;
    ctx.setLineDash([4, 3]);
    ctx.lineWidth = 1.5;
    ctx.strokeStyle = "#fff";
    ctx.strokeRect((rect.x - x) * k, (rect.y - y) * k, rect.columns * k, rect.rows * k);
    ctx.setLineDash([]);
  }
}
