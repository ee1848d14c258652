// Numbers into pixels.

import { MISSING, pack, shadedTable, shadeOf, SHADES, srgb, stripe, STRIPES, table, timeHue, type MapName, type Scale } from "./colour";
import { yieldToBrowser, type Volume } from "./volume";

/** A picture of a video's own size, to be drawn at any other. */
export class Bitmap {
  readonly canvas: HTMLCanvasElement;
  private readonly image: ImageData;
  readonly pixels: Uint32Array;

  constructor(
    readonly rows: number,
    readonly columns: number,
  ) {
    this.canvas = document.createElement("canvas");
    this.canvas.width = columns;
    this.canvas.height = rows;
    this.image = new ImageData(columns, rows);
    this.pixels = new Uint32Array(this.image.data.buffer);
  }

  done(): void {
    this.canvas.getContext("2d")!.putImageData(this.image, 0, 0);
  }

  /** Bin `t` between the brightness limits. */
  bin(volume: Volume, t: number, map: MapName, low: number, high: number, shades: Scale): void {
    const colours = shadedTable(map, shades);
    const top = SHADES - 1;
    const from = (low - volume.low) / volume.step;
    const scale = (top + 0.999) / Math.max(1e-9, (high - low) / volume.step);
    const { pixels } = this;
    const { missing } = volume;
    if (!volume.loaded[t]) {
      pixels.fill(MISSING);
    } else {
      const bin = volume.bin(t);
      for (let i = 0; i < bin.length; i++) {
        const n = bin[i];
        const f = (n - from) * scale;
        pixels[i] = n === missing ? MISSING : colours[f <= 0 ? 0 : f >= top ? top : f | 0];
      }
    }
    this.done();
  }

  /** Values around zero: −`most` is blue, `most` red. */
  signed(value: (i: number) => number, most: number): void {
    const colours = table("signed");
    for (let i = 0; i < this.pixels.length; i++) {
      const v = value(i);
      this.pixels[i] = Number.isFinite(v)
        ? colours[Math.min(255, Math.max(0, Math.round(127.5 + (127.5 * v) / most)))]
        : MISSING;
    }
    this.done();
  }

  /** Hatches the pixels that are not observed, over what was drawn. */
  hatch(isUnobserved: (pixel: number) => boolean): void {
    const { columns, pixels } = this;
    const colours = STRIPES.map(pack);
    for (let i = 0; i < pixels.length; i++) {
      if (isUnobserved(i)) pixels[i] = colours[stripe(Math.floor(i / columns), i % columns)];
    }
    this.done();
  }

  /** Values of a picture between two limits. */
  values(data: ArrayLike<number>, map: MapName, low: number, high: number, shades: Scale = { kind: "linear", gamma: 1 }): void {
    const colours = shadedTable(map, shades);
    const top = SHADES - 1;
    const scale = top / (high > low ? high - low : 1);
    for (let i = 0; i < this.pixels.length; i++) {
      const v = data[i];
      this.pixels[i] = Number.isFinite(v)
        ? colours[Math.min(top, Math.max(0, Math.round((v - low) * scale)))]
        : MISSING;
    }
    this.done();
  }
}

/** Largest value of each pixel over time, and the hue of its light's mean time. */
export interface Projection {
  peak: Float32Array;
  /** Linear-light RGB of full brightness. */
  hue: Float32Array;
}

export async function project(volume: Volume): Promise<Projection> {
  const { bins, pixels, missing, low, step } = volume;
  const peak = new Float32Array(pixels);
  const sum = new Float32Array(pixels);
  const hue = new Float32Array(3 * pixels);
  for (let t = 0; t < bins; t++) {
    const [r, g, b] = timeHue(bins > 1 ? t / (bins - 1) : 0);
    const bin = volume.bin(t);
    for (let i = 0; i < pixels; i++) {
      if (bin[i] === missing) continue;
      const v = low + bin[i] * step;
      if (v <= 0) continue;
      if (v > peak[i]) peak[i] = v;
      // Squares: a faint veil does not turn a flash grey.
      const w = v * v;
      sum[i] += w;
      hue[3 * i] += w * r;
      hue[3 * i + 1] += w * g;
      hue[3 * i + 2] += w * b;
    }
    if (t % 16 === 15) await yieldToBrowser();
  }
  for (let i = 0; i < pixels; i++) {
    const s = sum[i] || 1;
    for (let c = 0; c < 3; c++) hue[3 * i + c] /= s;
  }
  return { peak, hue };
}

/** Draws a projection: time as hue, or the peak alone. */
export function drawProjection(
  bitmap: Bitmap,
  { peak, hue }: Projection,
  layer: "time" | "peak",
  map: MapName,
  low: number,
  high: number,
  shades: Scale,
): void {
  if (layer === "peak") {
    bitmap.values(peak, map, low, high, shades);
    return;
  }
  for (let i = 0; i < peak.length; i++) {
    const f = shadeOf((peak[i] - low) / (high - low || 1), shades);
    bitmap.pixels[i] = pack(srgb([f * hue[3 * i], f * hue[3 * i + 1], f * hue[3 * i + 2]]));
  }
  bitmap.done();
}
