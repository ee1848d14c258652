// A video in memory: whole numbers with their scale, some bins of which may still be on their way.

import type { Rect } from "./types";

export class Volume {
  readonly bins: number;
  readonly rows: number;
  readonly columns: number;
  readonly data: Uint16Array | Uint8Array;
  /** Which bins are there. */
  readonly loaded: Uint8Array;
  /** Number of bins that are there. */
  count = 0;
  /** Value of number 0, and of one step. */
  low: number;
  step: number;
  /** The number that stands for no value. */
  readonly missing: number;
  /** Voxels of each number, of the bins that are there. */
  private histogram_: Uint32Array | null = null;
  private still_: Volume | null = null;

  constructor(shape: [number, number, number], range: [number, number], bits: 8 | 16, data?: Uint8Array) {
    [this.bins, this.rows, this.columns] = shape;
    const voxels = this.bins * this.rows * this.columns;
    this.data = bits === 8 ? (data ?? new Uint8Array(voxels)) : new Uint16Array(voxels);
    this.missing = bits === 8 ? 255 : 65535;
    this.low = range[0];
    this.step = (range[1] - range[0]) / (this.missing - 1);
    this.loaded = new Uint8Array(this.bins);
    if (data) {
      this.loaded.fill(1);
      this.count = this.bins;
    }
  }

  get pixels(): number {
    return this.rows * this.columns;
  }

  get high(): number {
    return this.low + this.step * (this.missing - 1);
  }

  get isWhole(): boolean {
    return this.count === this.bins;
  }

  put(from: number, numbers: Uint16Array): void {
    this.data.set(numbers, from * this.pixels);
    const bins = numbers.length / this.pixels;
    let replaced = false;
    this.still_ = null;
    for (let t = from; t < from + bins; t++) {
      if (this.loaded[t]) replaced = true;
      else this.count++;
      this.loaded[t] = 1;
    }
    // Counted as it comes: a large video is not gone through again for each part of it.
    if (replaced) this.histogram_ = null;
    else if (this.histogram_) for (let i = 0; i < numbers.length; i++) this.histogram_[numbers[i]]++;
  }

  /** The numbers of bin `t`. */
  bin(t: number): Uint16Array | Uint8Array {
    return this.data.subarray(t * this.pixels, (t + 1) * this.pixels);
  }

  value(t: number, y: number, x: number): number {
    const n = this.data[(t * this.rows + y) * this.columns + x];
    return this.loaded[t] && n !== this.missing ? this.low + n * this.step : NaN;
  }

  /** Mean of a region in each bin; NaN where it is not there yet. */
  trace(region: Rect): Float64Array {
    const out = new Float64Array(this.bins).fill(NaN);
    for (let t = 0; t < this.bins; t++) {
      if (!this.loaded[t]) continue;
      let [sum, count] = [0, 0];
      for (let y = region.y; y < region.y + region.rows; y++) {
        const row = (t * this.rows + y) * this.columns + region.x;
        for (let i = row; i < row + region.columns; i++) {
          const n = this.data[i];
          if (n !== this.missing) {
            sum += n;
            count++;
          }
        }
      }
      if (count) out[t] = this.low + (sum / count) * this.step;
    }
    return out;
  }

  /** The mean over time as a video of one bin; its numbers are those of this video. Null while bins are missing. */
  still(): Volume | null {
    if (this.still_ || !this.isWhole) return this.still_;
    const { rows, columns, pixels } = this;
    const [sums, counts] = [new Float64Array(pixels), new Uint32Array(pixels)];
    for (let t = 0; t < this.bins; t++) {
      const bin = this.bin(t);
      for (let i = 0; i < pixels; i++) {
        if (bin[i] === this.missing) continue;
        sums[i] += bin[i];
        counts[i]++;
      }
    }
    const still = new Volume([1, rows, columns], [this.low, this.high], 16);
    const scale = (still.missing - 1) / (this.missing - 1);
    still.put(0, Uint16Array.from(sums, (sum, i) => (counts[i] ? Math.round((sum / counts[i]) * scale) : still.missing)));
    this.still_ = still;
    return still;
  }

  /** Voxels of each number. */
  histogram(): Uint32Array {
    if (this.histogram_) return this.histogram_;
    const counts = new Uint32Array(this.missing + 1);
    for (let t = 0; t < this.bins; t++) {
      if (!this.loaded[t]) continue;
      const bin = this.bin(t);
      for (let i = 0; i < bin.length; i++) counts[bin[i]]++;
    }
    this.histogram_ = counts;
    return counts;
  }

  /** The number below which all but `most` voxels lie. */
  numberAbove(most: number): number {
    const counts = this.histogram();
    let above = 0;
    for (let n = this.missing - 1; n > 0; n--) {
      above += counts[n];
      if (above > most) return n;
    }
    return 0;
  }

  /** White point: what the brightest voxels reach, but for a few that are alone. */
  whitePoint(): number {
    const total = this.count * this.pixels;
    const n = this.numberAbove(Math.max(1, total * 2e-5));
    const zero = Math.max(0, Math.round(-this.low / this.step));
    return n > zero ? this.low + n * this.step : this.high;
  }

  /** The brightest pixel over all bins that are there, as [y, x]. */
  brightest(): [number, number] {
    let [best, at] = [-1, 0];
    for (let i = 0; i < this.data.length; i++) {
      if (this.data[i] > best && this.data[i] !== this.missing) {
        best = this.data[i];
        at = i % this.pixels;
      }
    }
    return [Math.floor(at / this.columns), at % this.columns];
  }
}

/** Lets the page draw and answer between parts of long work. */
export function yieldToBrowser(): Promise<void> {
  return new Promise((resolve) => setTimeout(resolve, 0));
}
