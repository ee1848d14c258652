// The clip as it is saved: each bin as numbers of colours, the same for GIF and MP4.

import { BAR_WIDTH, drawColourBar } from "./colour-bar";
import { colourOf, REGION_COLOURS, shadeOf, stripe, STRIPES, type Rgb } from "./colour";
import type { Pane } from "./pane";
import type { Store } from "./store";

/** Shades of brightness, and as many of signed differences; 256 colours in all, as a GIF may have. */
const SHADES = 121;
const FIRST_STRIPE = 2 * SHADES;
const FIRST_REGION = FIRST_STRIPE + STRIPES.length;
const [WHITE, BLACK] = [254, 255];
/** Stands for a pixel over which nothing is drawn. */
const NOTHING = 253;
/** Width of a saved picture at least, in pixels; small videos are enlarged by whole numbers. */
const MIN_WIDTH = 480;
export const GAP = 8;

/** Size of one pane as it is saved. */
export function savedSize({ volume }: Pane): { width: number; height: number } {
  const k = Math.max(1, Math.ceil(MIN_WIDTH / volume.columns));
  return { width: volume.columns * k, height: volume.rows * k };
}

/** A pane in its place, with the part of the video that it shows. */
interface PanePlacement {
  pane: Pane;
  left: number;
  width: number;
  height: number;
  window: [number, number, number, number];
}

export class Clip {
  readonly palette: Rgb[] = [];
  readonly width: number;
  readonly height: number;
  private readonly panes: PanePlacement[] = [];
  private readonly limits: [number, number];
  private readonly otherLimits: [number, number];
  private readonly isStamped: boolean;
  private readonly scale: Store["state"]["scale"];
  private readonly first: number;
  /** What lies over all bins: regions, line, scale bar, colour bar. */
  private readonly over: Uint8Array | null;
  readonly bins: number;

  /** What the panes show now: colours, limits, zoom, and the part of the time. */
  constructor(
    private readonly store: Store,
    panes: Pane[],
  ) {
    const { state } = store;
    this.limits = [state.low, state.high];
    this.otherLimits = store.otherLimits;
    this.isStamped = state.stamp;
    this.scale = state.scale;
    this.first = state.first;
    this.bins = state.last - state.first + 1;
    for (const map of [state.map, "signed"] as const) {
      for (let i = 0; i < SHADES; i++) this.palette.push(colourOf(map, i / (SHADES - 1)));
    }
    this.palette.push(...STRIPES, ...REGION_COLOURS.map(rgb));
    while (this.palette.length < WHITE) this.palette.push([255, 255, 255]);
    this.palette.push([255, 255, 255], [0, 0, 0]);
    let left = 0;
    for (const pane of panes) {
      const size = savedSize(pane);
      this.panes.push({ pane, left, window: pane.window(), ...size });
      left += size.width + GAP;
    }
    this.height = Math.max(...this.panes.map((p) => p.height));
    this.width = left - GAP + (state.colourBar ? BAR_WIDTH : 0);
    this.over = state.overlays || state.colourBar ? this.overlay(left - GAP) : null;
  }

  /** Picture `i` of the clip, with its time where that is wanted. */
  at(i: number): Uint8Array<ArrayBuffer> {
    const { store, width, height, over } = this;
    const t = this.first + i;
    const index = new Uint8Array(width * height).fill(WHITE);
    for (const placed of this.panes) this.paint(index, placed, t);
    if (over) for (let k = 0; k < over.length; k++) if (over[k] !== NOTHING) index[k] = over[k];
    if (this.isStamped) stampOn(index, width, height, store.clock.label(t));
    return index;
  }

  /** The numbers of the colours of what does not change. */
  private overlay(barLeft: number): Uint8Array {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [this.width, this.height];
    const ctx = canvas.getContext("2d", { willReadFrequently: true })!;
    const { state, unit } = this.store;
    for (const { pane, left, width, height } of state.overlays ? this.panes : []) {
      ctx.save();
      ctx.beginPath();
      ctx.rect(left, 0, width, height);
      ctx.clip();
      ctx.translate(left, 0);
      pane.drawOverlays(ctx, width, height);
      ctx.restore();
    }
    const marks = this.nearest(ctx, FIRST_REGION);
    if (!state.colourBar) return marks;
    ctx.clearRect(0, 0, canvas.width, canvas.height);
    drawColourBar(ctx, { x: barLeft + GAP, y: 0, width: BAR_WIDTH, height: this.height }, { ...state, unit }, { text: "#000", line: "#000" });
    const bar = this.nearest(ctx, 0);
    for (let i = 0; i < bar.length; i++) if (bar[i] !== NOTHING) marks[i] = bar[i];
    return marks;
  }

  /** For each opaque pixel of a canvas the colour of the palette, from `first` on, that is nearest. */
  private nearest(ctx: CanvasRenderingContext2D, first: number): Uint8Array {
    const { data } = ctx.getImageData(0, 0, this.width, this.height);
    const numbers = new Uint8Array(this.width * this.height).fill(NOTHING);
    const known = new Map<number, number>();
    for (let i = 0; i < numbers.length; i++) {
      if (data[4 * i + 3] < 128) continue;
      const [r, g, b] = data.subarray(4 * i, 4 * i + 3);
      const key = (r << 16) | (g << 8) | b;
      let best = known.get(key);
      if (best === undefined) {
        let least = Infinity;
        best = WHITE;
        this.palette.forEach((colour, n) => {
          // Signed differences and stripes have no part in marks and bar.
          if (n < first || (n >= SHADES && n < FIRST_REGION) || n === NOTHING) return;
          const distance = (colour[0] - r) ** 2 + (colour[1] - g) ** 2 + (colour[2] - b) ** 2;
          if (distance < least) [least, best] = [distance, n];
        });
        known.set(key, best!);
      }
      numbers[i] = best!;
    }
    return numbers;
  }

  private paint(index: Uint8Array, { pane, left, width, height, window }: PanePlacement, t: number): void {
    const { volume, coverage } = pane;
    const [x0, y0, w, hgt] = window;
    const [low, high] = pane.role === "other" ? this.otherLimits : this.limits;
    const bin = pane.binAt(t);
    const subtracted = pane.subtracted(t);
    const isUnobserved = coverage?.unobservedIn(bin) ?? (() => false);
    for (let y = 0; y < height; y++) {
      const row = Math.min(volume.rows - 1, Math.floor(y0 + (y / height) * hgt));
      for (let x = 0; x < width; x++) {
        const column = Math.min(volume.columns - 1, Math.floor(x0 + (x / width) * w));
        const value = volume.value(bin, row, column);
        let shade: number;
        if (isUnobserved(row * volume.columns + column)) {
          shade = FIRST_STRIPE + stripe(row, column);
        } else if (subtracted) {
          const less = subtracted[0].value(subtracted[1], row, column);
          shade = SHADES + numberOf(0.5 + (value - less) / (high - low));
        } else {
          shade = numberOf(shadeOf((value - low) / (high - low || 1), this.scale));
        }
        index[y * this.width + left + x] = shade;
      }
    }
  }
}

function numberOf(f: number): number {
  return Number.isFinite(f) ? Math.round(Math.min(1, Math.max(0, f)) * (SHADES - 1)) : 0;
}

function rgb(text: string): Rgb {
  const n = parseInt(text.slice(1), 16);
  return [n >> 16, (n >> 8) & 255, n & 255];
}

/** The time in white on black, at the lower left. */
function stampOn(index: Uint8Array, width: number, height: number, words: string): void {
  const canvas = document.createElement("canvas");
  const size = Math.max(12, Math.round(width / 32));
  canvas.width = Math.min(width, size * 9);
  canvas.height = Math.round(size * 1.6);
  const ctx = canvas.getContext("2d", { willReadFrequently: true })!;
  ctx.font = `600 ${size}px system-ui, sans-serif`;
  ctx.fillStyle = "#fff";
  ctx.fillText(words, size * 0.4, size * 1.15);
  const wide = Math.min(canvas.width, Math.ceil(ctx.measureText(words).width + size * 0.8));
  const { data } = ctx.getImageData(0, 0, canvas.width, canvas.height);
  const top = height - canvas.height;
  for (let y = 0; y < canvas.height && top + y >= 0; y++) {
    for (let x = 0; x < wide; x++) index[(top + y) * width + x] = data[4 * (y * canvas.width + x) + 3] > 127 ? WHITE : BLACK;
  }
}
