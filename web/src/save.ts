// PNG of what is seen; GIF and MP4 of the clip; with or without time, regions and colour bar.

import { GIFEncoder } from "gifenc";
import { Clip, GAP, savedSize } from "./clip";
import { BAR_WIDTH, drawColourBar } from "./colour-bar";
import { announce, download, h } from "./dom";
import { mp4 } from "./movie";
import type { Keys } from "./keys";
import type { PaneGrid } from "./pane-grid";
import type { State, Store } from "./store";
import { yieldToBrowser } from "./volume";

export class Save {
  readonly element: HTMLElement;
  private readonly status: HTMLElement;
  private readonly clips: HTMLButtonElement[];

  constructor(
    private readonly store: Store,
    private readonly paneGrid: PaneGrid,
    keys: Keys,
  ) {
    const box = (id: string, key: "stamp" | "overlays" | "colourBar", text: string) => {
      const input = h("input", {
        type: "checkbox",
        id,
        checked: store.state[key],
        change: () => store.set({ [key]: input.checked } as Partial<State>, "look"),
      });
      return h("label", {}, input, ` ${text}`);
    };
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
      box("stamp", "stamp", "time"),
      box("overlays", "overlays", "regions and scale bar"),
      box("colour-bar", "colourBar", "colour bar"),
      this.status,
    );
    keys.add("Page", "W", "saves a PNG of the view", { w: () => void this.png() });
  }

  async png(): Promise<void> {
    const canvas = document.createElement("canvas");
    const ctx = canvas.getContext("2d")!;
    const { panes } = this.paneGrid;
    const sizes = panes.map(savedSize);
    const { state, unit } = this.store;
    const wide = sizes.reduce((w, s) => w + s.width + GAP, -GAP);
    canvas.width = wide + (state.colourBar ? BAR_WIDTH : 0);
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
      pane.drawPixels(ctx, width, height);
      if (state.overlays) pane.drawOverlays(ctx, width, height);
      if (state.stamp && !pane.isSigned) pane.drawTime(ctx, height);
      ctx.restore();
      x += width + GAP;
    });
    if (state.colourBar) {
      const place = { x: wide + GAP, y: 0, width: BAR_WIDTH, height: canvas.height };
      drawColourBar(ctx, place, { ...state, unit }, { text: "#000", line: "#000" });
    }
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
    const { first, last } = this.store.state;
    this.status.textContent = `${done} of ${last - first + 1}`;
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
