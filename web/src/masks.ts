// Masks of a result: pixels of the frame that were left out, and voxels that the frame observes.

import { STRIPES, type Rgb } from "./colour";
import { h } from "./dom";
import { percent } from "./format";
import type { Picture } from "./types";
import type { Volume } from "./volume";

/** Green: in neither the grey frame nor the blue and red residual. */
const EXCLUDED_COLOUR = "#00a33a";
/** Smallest side of a mark, in CSS pixels: a single pixel of a large frame is seen. */
const MIN_MARK = 2;

/** The pixels of the frame that were left out, over the frame and the residual. */
export class ExcludedOverlay {
  /** The check box and the number of pixels; empty where no pixel was left out. */
  readonly legend = h("div", { class: "row overlays", hidden: true });
  private readonly pixels: number[] = [];
  private rows = 1;
  private columns = 1;
  private isShown = true;
  private marks: HTMLCanvasElement | null = null;

  constructor(
    private readonly id: string,
    private readonly onChange: () => void,
  ) {}

  /** Takes the mask: 1 at the pixels that were left out. */
  set({ rows, columns, data }: Picture): void {
    [this.rows, this.columns] = [rows, columns];
    data.forEach((value, i) => value > 0 && this.pixels.push(i));
    if (this.pixels.length === 0) return;
    const box = h("input", {
      type: "checkbox",
      id: this.id,
      checked: true,
      change: () => {
        this.isShown = box.checked;
        this.onChange();
      },
    });
    this.legend.append(h("label", {}, box, " ", swatch(EXCLUDED_COLOUR), ` ${excludedText(this.pixels.length, data.length)}`));
    this.legend.hidden = false;
    this.onChange();
  }

  drawOn(ctx: CanvasRenderingContext2D, width: number, height: number): void {
    if (!this.isShown || this.pixels.length === 0) return;
    const { canvas } = ctx;
    // The frame is drawn at each bin; its marks change only with its size.
    if (this.marks?.width !== canvas.width || this.marks.height !== canvas.height) {
      this.marks = this.drawMarks(canvas.width, canvas.height, canvas.width / width);
    }
    ctx.drawImage(this.marks, 0, 0, width, height);
  }

  private drawMarks(width: number, height: number, ratio: number): HTMLCanvasElement {
    const { rows, columns } = this;
    const marks = h("canvas", { width, height });
    const ctx = marks.getContext("2d")!;
    ctx.fillStyle = EXCLUDED_COLOUR;
    const [wide, tall] = [width / columns, height / rows];
    // Whole pixels of the screen: neighbouring marks have no seam.
    const [w, hgt] = [wide, tall].map((side) => Math.ceil(Math.max(side, MIN_MARK * ratio)));
    for (const i of this.pixels) {
      const [y, x] = [Math.floor(i / columns), i % columns];
      ctx.fillRect(Math.floor((x + 0.5) * wide - w / 2), Math.floor((y + 0.5) * tall - hgt / 2), w, hgt);
    }
    return marks;
  }
}

/** The voxels that the frame observes. */
export class Coverage {
  private pixelsWithout: Uint8Array | null = null;

  constructor(
    /** Not zero where a voxel is observed. */
    private readonly volume: Volume,
    /** Part of the voxels that is observed. */
    private readonly fraction: number | null,
  ) {}

  /** Which pixels of bin `t` are not observed; none while the bin is on its way. */
  unobservedIn(t: number): (pixel: number) => boolean {
    if (!this.volume.loaded[t]) return () => false;
    const bin = this.volume.bin(t);
    return (pixel) => bin[pixel] === 0;
  }

  /** Which pixels are observed in no bin; none while bins are on their way. */
  unobservedThroughout(): (pixel: number) => boolean {
    const { volume } = this;
    if (!volume.isWhole) return () => false;
    if (!this.pixelsWithout) {
      const without = new Uint8Array(volume.pixels).fill(1);
      for (let t = 0; t < volume.bins; t++) {
        const bin = volume.bin(t);
        for (let i = 0; i < bin.length; i++) if (bin[i] !== 0) without[i] = 0;
      }
      this.pixelsWithout = without;
    }
    const without = this.pixelsWithout;
    return (pixel) => without[pixel] === 1;
  }

  legend(): HTMLElement {
    const [dark, light] = STRIPES.map(rgb);
    const hatching = swatch(`repeating-linear-gradient(135deg, ${dark} 0 3px, ${light} 3px 4px)`);
    return h("span", { class: "mask" }, hatching, ` ${unobservedText(this.fraction)}`);
  }
}

export function excludedText(count: number, pixels: number): string {
  return `${count} ${count === 1 ? "pixel" : "pixels"} left out (${percent(count / pixels)})`;
}

export function unobservedText(fraction: number | null): string {
  const part = fraction == null ? "" : ` (${percent(1 - fraction)} of the voxels)`;
  return `not observed by the frame${part}`;
}

function swatch(background: string): HTMLElement {
  const element = h("span", { class: "swatch", "aria-hidden": "true" });
  element.style.background = background;
  return element;
}

function rgb([r, g, b]: Rgb): string {
  return `rgb(${r} ${g} ${b})`;
}
