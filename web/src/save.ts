// PNG of what is seen; GIF and MP4 of the clip, with or without the time.

import { GIFEncoder } from "gifenc";
import { Clip, GAP, savedSize } from "./clip";
import { announce, download, h } from "./dom";
import { mp4 } from "./movie";
import type { PaneGrid } from "./pane-grid";
import type { Store } from "./store";
import { yieldToBrowser } from "./volume";

export class Save {
  readonly element: HTMLElement;
  private readonly status: HTMLElement;
  private readonly clips: HTMLButtonElement[];

  constructor(
    private readonly store: Store,
    private readonly paneGrid: PaneGrid,
  ) {
    const stamp = h("input", {
      type: "checkbox",
      id: "stamp",
      checked: store.state.stamp,
      change: () => store.set({ stamp: stamp.checked }, "look"),
    });
    this.status = h("span", { class: "muted", role: "status", id: "save-words" });
    const clip = (id: string, text: string, save: () => Promise<string>) =>
      h("button", { type: "button", id, click: () => void this.keep(save) }, text);
    this.clips =
      store.clock.bins > 1
        ? [clip("save-mp4", "MP4 of the clip", () => this.mp4()), clip("save-gif", "GIF of the clip", () => this.gif())]
        : [];
    this.element = h(
      "section",
      { class: "save row", "aria-label": "Save" },
      h("button", { type: "button", id: "save-png", click: () => void this.png() }, "PNG of the view"),
      ...this.clips,
      h("label", {}, stamp, " with the time"),
      this.status,
    );
  }

  async png(): Promise<void> {
    const canvas = document.createElement("canvas");
    const ctx = canvas.getContext("2d")!;
    const { panes } = this.paneGrid;
    const sizes = panes.map(savedSize);
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

  /** Saves a clip, one at a time, and says how it went. */
  private async keep(save: () => Promise<string>): Promise<void> {
    if (!this.store.video.isWhole) {
      this.status.textContent = "The video is still loading.";
      return;
    }
    for (const button of this.clips) button.disabled = true;
    try {
      this.status.textContent = await save();
    } catch (error) {
      this.status.textContent = `The clip could not be made: ${error instanceof Error ? error.message : String(error)}`;
    }
    for (const button of this.clips) button.disabled = false;
    announce(this.status.textContent);
  }

  private progress(done: number): void {
    this.status.textContent = `${done} of ${this.store.clock.bins}`;
  }

  async mp4(): Promise<string> {
    const { store } = this;
    const blob = await mp4(new Clip(store, this.paneGrid.panes), store.state.speed, (done) => this.progress(done));
    if (!blob) return "This browser cannot encode video: save the GIF, or use Chrome, Edge, Safari or a newer Firefox.";
    download(`${store.meta.name}.mp4`, blob);
    return "MP4 saved";
  }

  async gif(): Promise<string> {
    const { store } = this;
    const clip = new Clip(store, this.paneGrid.panes);
    const encoder = GIFEncoder();
    // Browsers slow down below 20 ms.
    const delay = Math.max(20, Math.round(1000 / store.state.speed));
    for (let t = 0; t < clip.bins; t++) {
      const first = t === 0 ? { palette: clip.palette, repeat: 0 } : {};
      encoder.writeFrame(clip.at(t), clip.width, clip.height, { delay, ...first });
      this.progress(t + 1);
      await yieldToBrowser();
    }
    encoder.finish();
    download(`${store.meta.name}.gif`, new Blob([encoder.bytes()], { type: "image/gif" }));
    return "GIF saved";
  }
}
