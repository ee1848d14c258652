// Space against time: x–t, y–t, and along a line that was dragged; with axes, and a tool for speeds.

import { drawAxes, type Place } from "./axis";
import { BAR_WIDTH, drawColourBar } from "./colour-bar";
import { css, download, fit, h } from "./dom";
import { number } from "./format";
import type { Keys } from "./keys";
import { Bitmap } from "./picture";
import type { Pitch, Store } from "./store";

type Name = "x" | "y" | "line";

/** A slope in a slice: bins and pixels along it. */
export interface Slope {
  t0: number;
  p0: number;
  t1: number;
  p1: number;
}

/** Pixels of a slice, and how far they are from each other. */
interface Cut {
  name: Name;
  title: string;
  axis: string;
  path: [number, number][];
  step_px: number;
}

interface Slice {
  canvas: HTMLCanvasElement;
  title: HTMLElement;
  element: HTMLElement;
  result: HTMLElement;
  bitmap: Bitmap | null;
  cut: Cut | null;
  slope: Slope | null;
}

/** Room for the axes, in CSS pixels. */
const [LEFT, RIGHT, TOP, BOTTOM] = [56, 10, 6, 38];
/** Size of a saved slice, in CSS pixels, and its pixels for each. */
const SAVED = { width: 640, height: 320, ratio: 2 };

/** The speed of a slope in words: pixels a bin, and m/s where pitch and time are known. */
export function speedOf({ t0, p0, t1, p1 }: Slope, step_us: number | null, pitch: Pitch | null): string {
  const [bins, px] = [t1 - t0, p1 - p0];
  if (bins === 0) return "no time passes along the line";
  const perBin = `${number(px / bins, 4)} px per bin`;
  if (step_us == null) return perBin;
  // µm over µs are m/s.
  return pitch == null
    ? `${perBin} · ${number(px / (bins * step_us), 4)} px/µs`
    : `${perBin} · ${number((px * pitch.um) / (bins * step_us), 4)} m/s ${pitch.place}`;
}

export class Slices {
  readonly element: HTMLElement;
  private readonly slices: Record<Name, Slice>;
  private readonly slopeButton: HTMLButtonElement;
  private measures = false;
  private stale = true;

  constructor(
    private readonly store: Store,
    keys: Keys,
  ) {
    this.slices = { x: this.slice("x"), y: this.slice("y"), line: this.slice("line") };
    this.slopeButton = h(
      "button",
      { type: "button", id: "slope", "aria-pressed": "false", title: "Drag along a trail in a slice (S)", click: () => this.toggleSlope() },
      "Slope",
    );
    this.element = h(
      "div",
      {},
      h(
        "div",
        { class: "row" },
        this.slopeButton,
        h("span", { class: "muted note" }, "The slices go through the selected region, else the last; drag your own line with the tool “Line”."),
      ),
      this.slices.line.element,
      this.slices.x.element,
      this.slices.y.element,
    );
    store.on((what) => {
      if (what === "regions" || what === "line" || what === "data" || what === "look") this.stale = true;
      if (what !== "probe" && what !== "marks") this.draw();
    });
    new ResizeObserver(() => this.draw()).observe(this.element);
    keys.add("Slices", "S", "measures speeds in the slices", { s: () => this.toggleSlope() });
    keys.note("Slices", "←  →  ↑  ↓", "on a slice, with Slope: the end of the line; with Shift its start");
  }

  private slice(name: Name): Slice {
    const canvas = h("canvas", { class: "slice", role: "img", tabindex: 0, "data-slice": name });
    const title = h("span");
    const result = h("output", { class: "speed", "data-speed": name });
    const save = (text: string, kind: string, act: () => void) =>
      h("button", { type: "button", class: "quiet", "data-save": `${name}-${kind}`, click: act }, text);
    const caption = h(
      "figcaption",
      { class: "row" },
      title,
      h("span", { class: "spring" }),
      save("PNG", "png", () => void this.savePng(name)),
      save("CSV", "csv", () => this.saveCsv(name)),
    );
    let start: { t: number; p: number } | null = null;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      start = this.at(name, event);
      if (!this.measures) this.goTo(start.t);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!start || !(event.buttons & 1)) return;
      const now = this.at(name, event);
      if (!this.measures) this.goTo(now.t);
      else this.setSlope(name, { t0: start.t, p0: start.p, t1: now.t, p1: now.p });
    });
    canvas.addEventListener("pointerup", () => (start = null));
    canvas.addEventListener("keydown", (event) => this.arrows(name, event));
    return { canvas, title, element: h("figure", {}, caption, canvas, result), result, bitmap: null, cut: null, slope: null };
  }

  private goTo(t: number): void {
    this.store.goTo(Math.floor(t));
  }

  private toggleSlope(): void {
    this.measures = !this.measures;
    this.slopeButton.setAttribute("aria-pressed", String(this.measures));
    if (!this.measures) for (const name of Object.keys(this.slices) as Name[]) this.setSlope(name, null);
  }

  private setSlope(name: Name, slope: Slope | null): void {
    const slice = this.slices[name];
    slice.slope = slope;
    const { clock, pitch } = this.store;
    slice.result.textContent = slope ? speedOf(slope, clock.step_us, pitch) : "";
    this.draw();
  }

  /** Arrow keys move an end of the slope. */
  private arrows(name: Name, event: KeyboardEvent): void {
    const ways: Record<string, [number, number]> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const way = ways[event.key];
    const { cut, slope } = this.slices[name];
    if (!this.measures || !way || !cut || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    event.stopPropagation();
    const [bins, length] = [this.store.clock.bins, (cut.path.length - 1) * cut.step_px + 1];
    const old = slope ?? { t0: 0, p0: length / 2, t1: bins, p1: length / 2 };
    const clamp = (v: number, most: number) => Math.min(most, Math.max(0, v));
    const next = event.shiftKey
      ? { ...old, t0: clamp(old.t0 + way[0], bins), p0: clamp(old.p0 + way[1], length) }
      : { ...old, t1: clamp(old.t1 + way[0], bins), p1: clamp(old.p1 + way[1], length) };
    this.setSlope(name, next);
  }

  private place(width: number, height: number): Place {
    return { x: LEFT, y: TOP, width: Math.max(1, width - LEFT - RIGHT), height: Math.max(1, height - TOP - BOTTOM) };
  }

  /** Bins and pixels along the slice under the pointer. */
  private at(name: Name, event: PointerEvent): { t: number; p: number } {
    const { canvas, cut } = this.slices[name];
    const box = canvas.getBoundingClientRect();
    const { x, y, width, height } = this.place(box.width, box.height);
    const part = (v: number) => Math.min(1, Math.max(0, v));
    const length = cut ? cut.path.length * cut.step_px : 1;
    return {
      t: part((event.clientX - box.left - x) / width) * this.store.clock.bins,
      p: part((event.clientY - box.top - y) / height) * length,
    };
  }

  /** The slices that there are. */
  private cuts(): Cut[] {
    const { state, video } = this.store;
    const region = state.regions.find((r) => r.id === state.selected) ?? state.regions[state.regions.length - 1];
    const row = region ? region.y + (region.rows >> 1) : video.rows >> 1;
    const column = region ? region.x + (region.columns >> 1) : video.columns >> 1;
    const along = (n: number, at: (i: number) => [number, number]) => Array.from({ length: n }, (_, i) => at(i));
    const cuts: Cut[] = [
      { name: "x", title: `x–t along row ${row}`, axis: "column", path: along(video.columns, (i) => [row, i]), step_px: 1 },
      { name: "y", title: `y–t along column ${column}`, axis: "row", path: along(video.rows, (i) => [i, column]), step_px: 1 },
    ];
    if (state.line) {
      const { x0, y0, x1, y1 } = state.line;
      const length = Math.hypot(x1 - x0, y1 - y0);
      const n = Math.max(2, Math.round(length) + 1);
      const clamp = (v: number, size: number) => Math.min(size - 1, Math.max(0, Math.floor(v)));
      const point = (i: number): [number, number] => {
        const f = i / (n - 1);
        return [clamp(y0 + f * (y1 - y0), video.rows), clamp(x0 + f * (x1 - x0), video.columns)];
      };
      cuts.unshift({ name: "line", title: "along the line, its start at the top", axis: "distance", path: along(n, point), step_px: length / (n - 1) || 1 });
    }
    return cuts;
  }

  /** Values of a slice, bin after bin for each of its pixels. */
  private values({ path }: Cut): Float32Array {
    const { video, clock } = this.store;
    const values = new Float32Array(path.length * clock.bins);
    path.forEach(([y, x], i) => {
      for (let t = 0; t < clock.bins; t++) values[i * clock.bins + t] = video.value(t, y, x);
    });
    return values;
  }

  draw(): void {
    // A tab that is not seen is drawn when it is.
    if (this.element.offsetParent === null) return;
    const { state, clock } = this.store;
    this.slices.line.element.hidden = !state.line;
    if (this.stale) {
      for (const cut of this.cuts()) {
        const slice = this.slices[cut.name];
        const isSame = slice.bitmap?.rows === cut.path.length && slice.bitmap.columns === clock.bins;
        if (!isSame || slice.cut?.title !== cut.title) this.setNothing(slice);
        slice.bitmap = isSame ? slice.bitmap! : new Bitmap(cut.path.length, clock.bins);
        slice.bitmap.values(this.values(cut), state.map, state.low, state.high, state.scale);
        slice.cut = cut;
        slice.title.textContent = cut.title;
        slice.canvas.setAttribute("aria-label", `${cut.title}, light over time`);
      }
      this.stale = false;
    }
    for (const slice of Object.values(this.slices)) {
      if (!slice.cut || slice.element.hidden) continue;
      const { ctx, width, height } = fit(slice.canvas);
      ctx.clearRect(0, 0, width, height);
      this.drawSlice(ctx, slice, this.place(width, height), { text: css("--muted"), line: css("--rule") });
      this.drawOver(ctx, slice, this.place(width, height));
    }
  }

  /** A slope belongs to one slice alone. */
  private setNothing(slice: Slice): void {
    slice.slope = null;
    slice.result.textContent = "";
  }

  private drawSlice(ctx: CanvasRenderingContext2D, slice: Slice, place: Place, ink: { text: string; line: string }): void {
    const { clock, pitch } = this.store;
    const { path, step_px, axis } = slice.cut!;
    ctx.imageSmoothingEnabled = false;
    ctx.drawImage(slice.bitmap!.canvas, place.x, place.y, place.width, place.height);
    const length = path.length * step_px;
    const inUm = axis === "distance" && pitch != null;
    drawAxes(
      ctx,
      place,
      { low: clock.start, high: clock.end, label: `time (${clock.unit})` },
      { low: 0, high: inUm ? length * pitch.um : length, label: inUm ? `distance (µm ${pitch.place})` : `${axis} (px)` },
      ink,
    );
  }

  /** The bin that is shown, and the slope. */
  private drawOver(ctx: CanvasRenderingContext2D, { slope, cut }: Slice, place: Place): void {
    const { state, clock } = this.store;
    const x = (t: number) => place.x + (t / clock.bins) * place.width;
    const y = (p: number) => place.y + (p / (cut!.path.length * cut!.step_px)) * place.height;
    ctx.fillStyle = css("--accent");
    ctx.fillRect(x(state.t + 0.5) - 1, place.y, 2, place.height);
    if (!slope) return;
    for (const [colour, width] of [["rgb(0 0 0 / 0.6)", 4], ["#fff", 1.75]] as const) {
      ctx.beginPath();
      ctx.moveTo(x(slope.t0), y(slope.p0));
      ctx.lineTo(x(slope.t1), y(slope.p1));
      ctx.strokeStyle = colour;
      ctx.lineWidth = width;
      ctx.stroke();
    }
  }

  private async savePng(name: Name): Promise<void> {
    const slice = this.slices[name];
    if (!slice.cut) return;
    const { state, unit, meta } = this.store;
    const { width, height, ratio } = SAVED;
    const whole = width + (state.colourBar ? BAR_WIDTH : 0);
    const canvas = h("canvas", { width: whole * ratio, height: height * ratio });
    const ctx = canvas.getContext("2d")!;
    ctx.scale(ratio, ratio);
    ctx.fillStyle = "#fff";
    ctx.fillRect(0, 0, whole, height);
    const ink = { text: "#333", line: "#888" };
    const place = this.place(width, height);
    this.drawSlice(ctx, slice, place, ink);
    if (state.overlays) this.drawOver(ctx, slice, place);
    if (state.colourBar) {
      drawColourBar(ctx, { x: width + 6, y: 0, width: BAR_WIDTH, height: height - BOTTOM + 6 }, { ...state, unit }, ink);
    }
    const blob = await new Promise<Blob | null>((resolve) => canvas.toBlob(resolve, "image/png"));
    if (blob) download(`${meta.name}-${name}-t.png`, blob);
  }

  /** A line for each pixel of the slice, a column for each bin. */
  private saveCsv(name: Name): void {
    const { cut } = this.slices[name];
    if (!cut) return;
    const { clock, meta } = this.store;
    const values = this.values(cut);
    const lines = [["row", "column", "distance_px", ...Array.from({ length: clock.bins }, (_, t) => (clock.step_us == null ? `bin_${t}` : `${Number(clock.at(t).toPrecision(9))}_us`))].join(",")];
    cut.path.forEach(([y, x], i) => {
      const row = Array.from(values.subarray(i * clock.bins, (i + 1) * clock.bins), (v) => (Number.isFinite(v) ? String(Number(v.toPrecision(7))) : ""));
      lines.push([y, x, Number((i * cut.step_px).toPrecision(7)), ...row].join(","));
    });
    download(`${meta.name}-${name}-t.csv`, new Blob([`${lines.join("\n")}\n`], { type: "text/csv" }));
  }
}
