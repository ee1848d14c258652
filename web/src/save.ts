// PNG of what is seen, and GIF of the clip.

import { GIFEncoder } from "gifenc";
import { colourOf } from "./colour";
import { announce, download, h } from "./dom";
import type { Pane } from "./pane";
import type { Stage } from "./stage";
import type { Store } from "./store";
import { breathe } from "./volume";

/** Colours of a GIF: brightness, signed differences, then ink and paper. */
const SHADES = 127;
const [WHITE, BLACK] = [254, 255];
/** Width of a saved picture at least, in pixels; small videos are enlarged by whole numbers. */
const LEAST = 480;
const GAP = 8;

export class Save {
  readonly element: HTMLElement;
  private readonly words: HTMLElement;

  constructor(
    private readonly store: Store,
    private readonly stage: Stage,
  ) {
    const stamp = h("input", {
      type: "checkbox",
      id: "stamp",
      checked: store.state.stamp,
      change: () => store.set({ stamp: stamp.checked }, "look"),
    });
    this.words = h("span", { class: "muted", role: "status" });
    const mp4 = store.source.fileUrl(0, "video.mp4");
    this.element = h(
      "section",
      { class: "save row", "aria-label": "Save" },
      h("button", { type: "button", id: "save-png", click: () => void this.png() }, "PNG of the view"),
      store.clock.bins > 1 && h("button", { type: "button", id: "save-gif", click: () => void this.gif() }, "GIF of the clip"),
      mp4 && h("a", { class: "button", href: mp4, download: `${store.meta.name}.mp4` }, "MP4"),
      h("label", {}, stamp, " with the time"),
      this.words,
    );
  }

  /** Enlargement, and the size of one pane. */
  private size(pane: Pane): { width: number; height: number } {
    const { rows, columns } = pane.volume;
    const k = Math.max(1, Math.ceil(LEAST / columns));
    return { width: columns * k, height: rows * k };
  }

  async png(): Promise<void> {
    const canvas = document.createElement("canvas");
    const ctx = canvas.getContext("2d")!;
    const { panes } = this.stage;
    const sizes = panes.map((p) => this.size(p));
    canvas.width = sizes.reduce((w, s) => w + s.width + GAP, -GAP);
    canvas.height = Math.max(...sizes.map((s) => s.height));
    ctx.fillStyle = "#fff";
    ctx.fillRect(0, 0, canvas.width, canvas.height);
    let x = 0;
    panes.forEach((pane, i) => {
      const { width, height } = sizes[i];
      ctx.save();
      ctx.beginPath();
      ctx.rect(x, 0, width, height);
      ctx.clip();
      ctx.translate(x, 0);
      pane.drawOn(ctx, width, height);
      ctx.restore();
      x += width + GAP;
    });
    const blob = await new Promise<Blob | null>((resolve) => canvas.toBlob(resolve, "image/png"));
    if (blob) download(`${this.store.meta.name}-${this.store.state.t}.png`, blob);
  }

  async gif(): Promise<void> {
    const { store } = this;
    const { clock, state } = store;
    const palette: number[][] = [];
    for (let i = 0; i < SHADES; i++) palette.push(colourOf(state.map, i / (SHADES - 1)));
    for (let i = 0; i < SHADES; i++) palette.push(colourOf("signed", i / (SHADES - 1)));
    palette.push([255, 255, 255], [0, 0, 0]);
    const panes = this.stage.panes.map((pane) => ({ pane, ...this.size(pane) }));
    const width = panes.reduce((w, p) => w + p.width + GAP, -GAP);
    const height = Math.max(...panes.map((p) => p.height));
    const encoder = GIFEncoder();
    for (let t = 0; t < clock.bins; t++) {
      const index = new Uint8Array(width * height).fill(WHITE);
      let left = 0;
      for (const { pane, width: w, height: hgt } of panes) {
        this.paint(index, width, left, pane, w, hgt, t);
        left += w + GAP;
      }
      if (state.stamp) stampOn(index, width, height, clock.label(t));
      // Browsers slow down below 20 ms.
      const delay = Math.max(20, Math.round(1000 / state.speed));
      encoder.writeFrame(index, width, height, { delay, ...(t === 0 ? { palette, repeat: 0 } : {}) });
      this.words.textContent = `${t + 1} of ${clock.bins}`;
      await breathe();
    }
    encoder.finish();
    this.words.textContent = "";
    announce("GIF saved");
    download(`${store.meta.name}.gif`, new Blob([encoder.bytes()], { type: "image/gif" }));
  }

  private paint(index: Uint8Array, stride: number, left: number, pane: Pane, width: number, height: number, t: number): void {
    const { store } = this;
    const { low, high } = store.state;
    const { volume } = pane;
    const [x0, y0, w, hgt] = pane.window();
    const [otherLow, otherHigh] = store.otherLimits;
    const bin = pane.role === "other" ? (store.otherClock?.bin(store.clock.at(t)) ?? t) : t;
    for (let y = 0; y < height; y++) {
      const row = Math.min(volume.rows - 1, Math.floor(y0 + (y / height) * hgt));
      for (let x = 0; x < width; x++) {
        const column = Math.min(volume.columns - 1, Math.floor(x0 + (x / width) * w));
        const value = volume.value(bin, row, column);
        let shade: number;
        if (pane.role === "difference") {
          const truth = store.truth!.value(bin, row, column);
          shade = SHADES + clamp(0.5 + (value - truth) / (high - low));
        } else {
          const [a, b] = pane.role === "other" ? [otherLow, otherHigh] : [low, high];
          shade = clamp((value - a) / (b - a || 1));
        }
        index[y * stride + left + x] = shade;
      }
    }
  }
}

function clamp(f: number): number {
  return Number.isFinite(f) ? Math.round(Math.min(1, Math.max(0, f)) * (SHADES - 1)) : 0;
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
