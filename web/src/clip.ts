// The clip as it is saved: each bin as numbers of colours, the same for GIF and MP4.

import { colourOf, stripe, STRIPES, type Rgb } from "./colour";
import type { Pane } from "./pane";
import type { Store } from "./store";

/** Colours: brightness, signed differences, stripes of a hatching, then ink and paper. 256 in all, as a GIF may have. */
const SHADES = 127;
/** Shades where two colours are for a hatching. */
const SHADES_BESIDE_STRIPES = 126;
const FIRST_STRIPE = 252;
const [WHITE, BLACK] = [254, 255];
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
  private readonly shades: number;

  /** What the panes show now: colours, limits and zoom. */
  constructor(
    private readonly store: Store,
    panes: Pane[],
  ) {
    this.limits = [store.state.low, store.state.high];
    this.otherLimits = store.otherLimits;
    this.isStamped = store.state.stamp;
    const isHatched = panes.some((pane) => pane.coverage);
    this.shades = isHatched ? SHADES_BESIDE_STRIPES : SHADES;
    for (const map of [store.state.map, "signed"] as const) {
      for (let i = 0; i < this.shades; i++) this.palette.push(colourOf(map, i / (this.shades - 1)));
    }
    if (isHatched) this.palette.push(...STRIPES);
    this.palette.push([255, 255, 255], [0, 0, 0]);
    let left = 0;
    for (const pane of panes) {
      const size = savedSize(pane);
      this.panes.push({ pane, left, window: pane.window(), ...size });
      left += size.width + GAP;
    }
    this.width = left - GAP;
    this.height = Math.max(...this.panes.map((p) => p.height));
  }

  get bins(): number {
    return this.store.clock.bins;
  }

  /** Bin `t`, with its time where that is wanted. */
  at(t: number): Uint8Array<ArrayBuffer> {
    const { store, width, height } = this;
    const index = new Uint8Array(width * height).fill(WHITE);
    for (const placed of this.panes) this.paint(index, placed, t);
    if (this.isStamped) stampOn(index, width, height, store.clock.label(t));
    return index;
  }

  private paint(index: Uint8Array, { pane, left, width, height, window }: PanePlacement, t: number): void {
    const { store, shades } = this;
    const { volume, coverage } = pane;
    const [x0, y0, w, hgt] = window;
    const [low, high] = pane.role === "other" ? this.otherLimits : this.limits;
    const bin = pane.role === "other" ? (store.otherClock?.bin(store.clock.at(t)) ?? t) : t;
    const isUnobserved = coverage?.unobservedIn(bin) ?? (() => false);
    for (let y = 0; y < height; y++) {
      const row = Math.min(volume.rows - 1, Math.floor(y0 + (y / height) * hgt));
      for (let x = 0; x < width; x++) {
        const column = Math.min(volume.columns - 1, Math.floor(x0 + (x / width) * w));
        const value = volume.value(bin, row, column);
        let shade: number;
        if (isUnobserved(row * volume.columns + column)) {
          shade = FIRST_STRIPE + stripe(row, column);
        } else if (pane.role === "difference") {
          const truth = store.truth!.value(bin, row, column);
          shade = shades + shadeOf(0.5 + (value - truth) / (high - low), shades);
        } else {
          shade = shadeOf((value - low) / (high - low || 1), shades);
        }
        index[y * this.width + left + x] = shade;
      }
    }
  }
}

function shadeOf(f: number, shades: number): number {
  return Number.isFinite(f) ? Math.round(Math.min(1, Math.max(0, f)) * (shades - 1)) : 0;
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
