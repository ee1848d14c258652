// One picture of the pane grid with what lies over it: regions, line, scale bar, time.

import { timeHue } from "./colour";
import { fit, h } from "./dom";
import { number } from "./format";
import type { Coverage } from "./masks";
import { Bitmap, drawProjection, project, type Projection } from "./picture";
import type { Store } from "./store";
import type { Volume } from "./volume";

export type Role = "main" | "truth" | "difference" | "still" | "change" | "other";

/** Lengths that a scale bar may have, in µm. */
const LENGTHS = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000, 20000, 50000, 100000];

export class Pane {
  readonly canvas: HTMLCanvasElement;
  readonly element: HTMLElement;
  private bitmap: Bitmap | null = null;
  private projection: Projection | null = null;
  private projecting = false;

  constructor(
    private readonly store: Store,
    readonly role: Role,
    readonly name: string,
  ) {
    this.canvas = h("canvas", { class: "picture", tabindex: 0, role: "img", "data-role": role });
    const ratio = store.otherRatio;
    const ownScale = role === "other" && ratio !== 1;
    this.element = h(
      "figure",
      { class: "pane" },
      this.canvas,
      h(
        "figcaption",
        {},
        name,
        ownScale && h("span", { class: "own-scale" }, ` · its own brightness scale: ${number(ratio, 2)} times the values`),
        this.coverage?.legend(),
      ),
    );
  }

  /** The video that is seen here. */
  get volume(): Volume {
    const { video, truth, other } = this.store;
    if (this.role === "still") return video.still() ?? video;
    return this.role === "truth" ? truth! : this.role === "other" ? other! : video;
  }

  /** What is subtracted from the video, and its bin, where values around zero are seen; null where the video itself is. */
  subtracted(bin: number): [Volume, number] | null {
    const { video, truth } = this.store;
    if (this.role === "difference") return [truth!, bin];
    const still = this.role === "change" ? video.still() : null;
    return still && [still, 0];
  }

  /** Whether values around zero are seen. */
  get isSigned(): boolean {
    return this.role === "difference" || this.role === "change";
  }

  /** Bin of what is seen here at bin `t` of the first video. */
  binAt(t: number): number {
    if (this.role === "still") return this.volume.bins === 1 ? 0 : t;
    return this.role === "other" ? this.store.otherBinAt(t) : t;
  }

  /** What the frame observes of the video; null where that is all. */
  get coverage(): Coverage | null {
    const { coverage, otherCoverage } = this.store;
    if (this.role === "truth" || this.role === "still") return null;
    return this.role === "other" ? otherCoverage : coverage;
  }

  get bin(): number {
    return this.binAt(this.store.state.t);
  }

  /** Forgets what was computed from the video. */
  forget(): void {
    this.projection = null;
  }

  limits(): [number, number] {
    const { low, high } = this.store.state;
    return this.role === "other" ? this.store.otherLimits : [low, high];
  }

  /** What a pixel of the first video has at its bin `t`, in words; null where this picture does not have it. */
  valueAt(y: number, x: number, t: number): string | null {
    const { store, volume, role } = this;
    const [row, column] = [Math.floor((y * volume.rows) / store.video.rows), Math.floor((x * volume.columns) / store.video.columns)];
    const bin = this.binAt(t);
    if (!volume.loaded[bin]) return null;
    const value = volume.value(bin, row, column);
    if (this.isSigned) {
      const subtracted = this.subtracted(t);
      return subtracted && `${role} ${number(value - subtracted[0].value(subtracted[1], row, column), 4)}`;
    }
    const words = store.valueWords(value, store.source.results[role === "other" ? 1 : 0]);
    return role === "main" ? words : `${this.name} ${words}`;
  }

  /** Paints the picture in its own size. */
  paint(): Bitmap {
    const { store, volume } = this;
    const { state } = store;
    this.bitmap ??= new Bitmap(volume.rows, volume.columns);
    const [low, high] = this.limits();
    if (this.isSigned) {
      this.bitmap.signed(this.difference(state.t), (high - low) / 2);
    } else if (this.role !== "still" && state.layer !== "video" && volume.isWhole) {
      if (this.projection) {
        drawProjection(this.bitmap, this.projection, state.layer, state.map, low, high, state.scale);
      } else if (!this.projecting) {
        this.projecting = true;
        void project(volume).then((projection) => {
          this.projection = projection;
          this.projecting = false;
          this.store.tell("look");
        });
      }
    } else {
      this.bitmap.bin(volume, this.bin, state.map, low, high, state.scale);
    }
    if (this.coverage) this.bitmap.hatch(this.unobserved(this.coverage));
    return this.bitmap;
  }

  /** The values around zero at bin `t`, by pixel. */
  private difference(t: number): (pixel: number) => number {
    const { video } = this.store;
    const [other, bin] = this.subtracted(t) ?? [video, t];
    const [a, b] = [video.bin(t), other.bin(bin)];
    const isThere = video.loaded[t] && other.loaded[bin] && this.subtracted(t);
    const of = (volume: Volume, n: number) => (n === volume.missing ? NaN : volume.low + n * volume.step);
    return (i) => (isThere ? of(video, a[i]) - of(other, b[i]) : NaN);
  }

  /** Which pixels of what is shown are not observed. */
  private unobserved(coverage: Coverage): (pixel: number) => boolean {
    const isOneBin = this.isSigned || this.store.state.layer === "video" || !this.volume.isWhole;
    return isOneBin ? coverage.unobservedIn(this.bin) : coverage.unobservedThroughout();
  }

  /** Part of the video that is seen: left, top, width and height in its pixels. */
  window(): [number, number, number, number] {
    const { zoom, cx, cy } = this.store.state;
    const { rows, columns } = this.volume;
    // Another size shows the same part.
    const [kx, ky] = [columns / this.store.video.columns, rows / this.store.video.rows];
    const [w, hgt] = [columns / zoom, rows / zoom];
    const x = Math.min(columns - w, Math.max(0, cx * kx - w / 2));
    const y = Math.min(rows - hgt, Math.max(0, cy * ky - hgt / 2));
    return [x, y, w, hgt];
  }

  draw(): void {
    const { ctx, width, height } = fit(this.canvas);
    if (this.volume.count === 0) {
      this.drawWaiting(ctx, width, height);
    } else {
      this.drawPixels(ctx, width, height);
      this.drawOverlays(ctx, width, height);
      this.drawProbe(ctx, width, height);
      if (this.store.state.stamp) this.drawTime(ctx, height);
    }
    this.describe();
  }

  /** Says that there is no picture yet, and what it waits for. */
  private drawWaiting(ctx: CanvasRenderingContext2D, width: number, height: number): void {
    const { source } = this.store;
    ctx.fillStyle = "#16191f";
    ctx.fillRect(0, 0, width, height);
    ctx.fillStyle = "#c9ced6";
    ctx.textAlign = "center";
    ctx.font = "600 15px system-ui, sans-serif";
    const running = source.live && !source.isMonitor;
    ctx.fillText(running ? "Setting up …" : source.live ? "Waiting for a frame …" : "Loading …", width / 2, height / 2);
    if (running) {
      ctx.font = "13px system-ui, sans-serif";
      ctx.fillText("The first picture comes with the first iterations.", width / 2, height / 2 + 22);
    }
  }

  drawPixels(ctx: CanvasRenderingContext2D, width: number, height: number): void {
    const bitmap = this.paint();
    const [x, y, w, hgt] = this.window();
    ctx.imageSmoothingEnabled = false;
    ctx.drawImage(bitmap.canvas, x, y, w, hgt, 0, 0, width, height);
  }

  /** Regions, line, scale bar and bar of time. */
  drawOverlays(ctx: CanvasRenderingContext2D, width: number, height: number): void {
    const k = this.onMarks(ctx, width, (k) => this.drawMarks(ctx, k));
    this.drawScaleBar(ctx, width, height, k);
    if (this.store.state.layer === "time" && this.role === "main") this.drawTimeBar(ctx, width);
  }

  /** Draws in pixels of the first video; returns CSS pixels for each of them. */
  private onMarks(ctx: CanvasRenderingContext2D, width: number, draw: (k: number) => void): number {
    const [x, y, w] = this.window();
    // A video of another size shows the same places.
    const { video } = this.store;
    const [kx, ky] = [this.volume.columns / video.columns, this.volume.rows / video.rows];
    const k = (width / w) * kx;
    ctx.save();
    ctx.scale(k, (width / w) * ky);
    ctx.translate(-x / kx, -y / ky);
    draw(k);
    ctx.restore();
    return k;
  }

  private drawProbe(ctx: CanvasRenderingContext2D, width: number, height: number): void {
    const { probe, tool } = this.store.state;
    if (!probe || tool !== "probe") return;
    const [x, y, w, hgt] = this.window();
    const at = { x: ((probe.x + 0.5 - x) / w) * width, y: ((probe.y + 0.5 - y) / hgt) * height };
    for (const [colour, wide] of [["rgb(0 0 0 / 0.6)", 3], ["#fff", 1]] as const) {
      ctx.strokeStyle = colour;
      ctx.lineWidth = wide;
      ctx.beginPath();
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        ctx.moveTo(at.x + 5 * dx, at.y + 5 * dy);
        ctx.lineTo(at.x + 16 * dx, at.y + 16 * dy);
      }
      ctx.stroke();
    }
  }

  private drawMarks(ctx: CanvasRenderingContext2D, k: number): void {
    const { regions, line, selected } = this.store.state;
    for (const region of regions) {
      // About the pixels, not on them.
      const out = 1.5 / k;
      const [x, y] = [region.x - out, region.y - out];
      const [columns, rows] = [region.columns + 2 * out, region.rows + 2 * out];
      ctx.lineWidth = 3.5 / k;
      ctx.strokeStyle = "rgb(0 0 0 / 0.55)";
      ctx.strokeRect(x, y, columns, rows);
      ctx.lineWidth = 1.75 / k;
      ctx.strokeStyle = region.colour;
      ctx.strokeRect(x, y, columns, rows);
      const isSelected = region.id === selected;
      ctx.font = `${isSelected ? 700 : 500} ${12 / k}px system-ui, sans-serif`;
      ctx.textAlign = "left";
      ctx.textBaseline = y * k < 14 ? "top" : "alphabetic";
      ctx.lineWidth = 3 / k;
      ctx.lineJoin = "round";
      ctx.strokeStyle = "rgb(0 0 0 / 0.75)";
      const at: [number, number] = y * k < 14 ? [x + columns + 2 / k, y] : [x, y - 3 / k];
      ctx.strokeText(String(region.number), ...at);
      ctx.fillStyle = "#fff";
      ctx.fillText(String(region.number), ...at);
    }
    ctx.textBaseline = "alphabetic";
    if (line) {
      ctx.beginPath();
      ctx.moveTo(line.x0, line.y0);
      ctx.lineTo(line.x1, line.y1);
      ctx.lineWidth = 3.5 / k;
      ctx.strokeStyle = "rgb(0 0 0 / 0.55)";
      ctx.stroke();
      ctx.lineWidth = 1.5 / k;
      ctx.strokeStyle = "#fff";
      ctx.stroke();
    }
  }

  /** The time that is shown, at the lower left. */
  drawTime(ctx: CanvasRenderingContext2D, height: number): void {
    const { clock, state } = this.store;
    if (state.layer !== "video" || this.role === "still") return;
    ctx.textAlign = "left";
    outlined(ctx, clock.label(state.t), 10, height - 10);
  }

  private drawScaleBar(ctx: CanvasRenderingContext2D, width: number, height: number, k: number): void {
    const { pitch: scale } = this.store;
    if (!scale || this.role !== "main") return;
    const pitch = scale.um;
    const length = LENGTHS.filter((l) => (l / pitch) * k < width / 4).pop();
    if (!length) return;
    const px = (length / pitch) * k;
    ctx.fillStyle = "rgb(0 0 0 / 0.55)";
    ctx.fillRect(width - 11 - px, height - 15, px + 2, 5);
    ctx.fillStyle = "#fff";
    ctx.fillRect(width - 10 - px, height - 14, px, 3);
    ctx.textAlign = "right";
    outlined(ctx, `${length < 1000 ? `${length} µm` : `${length / 1000} mm`} ${scale.place}`, width - 10, height - 20);
  }

  private drawTimeBar(ctx: CanvasRenderingContext2D, width: number): void {
    const wide = Math.min(160, width / 3);
    const bar = new Bitmap(1, 64);
    const hue = new Float32Array(192);
    const peak = new Float32Array(64).fill(1);
    for (let i = 0; i < 64; i++) hue.set(timeHue(i / 63), 3 * i);
    drawProjection(bar, { peak, hue }, "time", "grey", 0, 1, { kind: "linear", gamma: 1 });
    ctx.drawImage(bar.canvas, 10, 10, wide, 6);
    ctx.fillStyle = "#fff";
    ctx.textBaseline = "top";
    ctx.textAlign = "left";
    const { clock } = this.store;
    ctx.fillText(String(Number(clock.start.toPrecision(4))), 10, 20);
    ctx.textAlign = "right";
    ctx.fillText(`${Number(clock.end.toPrecision(4))} ${clock.unit}`, 10 + wide, 20);
    ctx.textBaseline = "alphabetic";
  }

  private describe(): void {
    const { store } = this;
    const words = `${this.name}, ${store.clock.label(store.state.t)}, ${store.state.regions.length} regions marked`;
    if (!store.state.playing) this.canvas.setAttribute("aria-label", words);
  }

  /** Pixel of the first video under the pointer. */
  at(event: PointerEvent | WheelEvent): { x: number; y: number } {
    const box = this.canvas.getBoundingClientRect();
    const [x, y, w, hgt] = this.window();
    const [kx, ky] = [
      this.store.video.columns / this.volume.columns,
      this.store.video.rows / this.volume.rows,
    ];
    return {
      x: (x + ((event.clientX - box.left) / box.width) * w) * kx,
      y: (y + ((event.clientY - box.top) / box.height) * hgt) * ky,
    };
  }
}

/** White words with a dark edge, to be read on any picture. */
function outlined(ctx: CanvasRenderingContext2D, words: string, x: number, y: number): void {
  ctx.font = "500 13px system-ui, sans-serif";
  ctx.textBaseline = "alphabetic";
  ctx.lineWidth = 3;
  ctx.lineJoin = "round";
  ctx.strokeStyle = "rgb(0 0 0 / 0.65)";
  ctx.strokeText(words, x, y);
  ctx.fillStyle = "#fff";
  ctx.fillText(words, x, y);
}
