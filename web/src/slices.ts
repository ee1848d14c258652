// Space against time: x–t, y–t, and along a line that was dragged.

import { css, fit, h } from "./dom";
import { Bitmap } from "./picture";
import type { Store } from "./store";

interface Slice {
  canvas: HTMLCanvasElement;
  title: HTMLElement;
  element: HTMLElement;
  bitmap: Bitmap | null;
}

export class Slices {
  readonly element: HTMLElement;
  private readonly slices: Record<"x" | "y" | "line", Slice>;
  private stale = true;

  constructor(private readonly store: Store) {
    const slice = (): Slice => {
      const canvas = h("canvas", { class: "slice", role: "img" });
      const title = h("figcaption");
      canvas.addEventListener("pointerdown", (event) => {
        canvas.setPointerCapture(event.pointerId);
        this.pick(canvas, event);
      });
      canvas.addEventListener("pointermove", (event) => {
        if (event.buttons & 1) this.pick(canvas, event);
      });
      return { canvas, title, element: h("figure", {}, title, canvas), bitmap: null };
    };
    this.slices = { x: slice(), y: slice(), line: slice() };
    this.element = h(
      "div",
      {},
      h("p", { class: "muted note" }, "Time runs to the right. The slices go through the last region; drag your own line with the tool “Line”."),
      this.slices.line.element,
      this.slices.x.element,
      this.slices.y.element,
    );
    store.on((what) => {
      if (what === "regions" || what === "line" || what === "data") this.stale = true;
      if (what === "look" || what === "line" || what === "regions" || what === "data" || what === "time") this.draw();
    });
    new ResizeObserver(() => this.draw()).observe(this.element);
  }

  private pick(canvas: HTMLCanvasElement, event: PointerEvent): void {
    const box = canvas.getBoundingClientRect();
    this.store.goTo(Math.floor(((event.clientX - box.left) / box.width) * this.store.clock.bins));
  }

  /** Pixels along each slice. */
  private paths(): [keyof Slices["slices"], string, [number, number][]][] {
    const { state, video } = this.store;
    const region = state.regions[state.regions.length - 1];
    const row = region ? region.y + (region.rows >> 1) : video.rows >> 1;
    const column = region ? region.x + (region.columns >> 1) : video.columns >> 1;
    const along = (n: number, at: (i: number) => [number, number]) => Array.from({ length: n }, (_, i) => at(i));
    const paths: [keyof Slices["slices"], string, [number, number][]][] = [
      ["x", `x–t along row ${row}`, along(video.columns, (i) => [row, i])],
      ["y", `y–t along column ${column}`, along(video.rows, (i) => [i, column])],
    ];
    if (state.line) {
      const { x0, y0, x1, y1 } = state.line;
      const n = Math.max(2, Math.round(Math.hypot(x1 - x0, y1 - y0)));
      const clamp = (v: number, size: number) => Math.min(size - 1, Math.max(0, Math.floor(v)));
      const point = (i: number): [number, number] => {
        const f = i / (n - 1);
        return [clamp(y0 + f * (y1 - y0), video.rows), clamp(x0 + f * (x1 - x0), video.columns)];
      };
      paths.unshift(["line", `along the line, ${n} pixels, from its start at the top`, along(n, point)]);
    }
    return paths;
  }

  draw(): void {
    // A tab that is not seen is drawn when it is.
    if (this.element.offsetParent === null) return;
    const { state, video, clock } = this.store;
    const paths = this.paths();
    this.slices.line.element.hidden = !state.line;
    for (const [name, title, path] of paths) {
      const slice = this.slices[name];
      slice.title.textContent = title;
      slice.canvas.setAttribute("aria-label", `${title}, light over time`);
      if (this.stale || slice.bitmap?.rows !== path.length) slice.bitmap = new Bitmap(path.length, clock.bins);
      const values = new Float32Array(path.length * clock.bins);
      for (let i = 0; i < path.length; i++) {
        const [y, x] = path[i];
        for (let t = 0; t < clock.bins; t++) values[i * clock.bins + t] = video.value(t, y, x);
      }
      slice.bitmap.values(values, state.map, state.low, state.high);
      const { ctx, width, height } = fit(slice.canvas);
      ctx.imageSmoothingEnabled = false;
      ctx.drawImage(slice.bitmap.canvas, 0, 0, width, height);
      ctx.fillStyle = css("--accent");
      ctx.fillRect(((state.t + 0.5) / clock.bins) * width - 1, 0, 2, height);
    }
    this.stale = false;
  }
}
