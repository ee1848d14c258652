// A camera that is looked at: raw frame, exposure, and what may be kept.

import { css, fit, h } from "./dom";
import { number } from "./format";
import { Bitmap } from "./picture";
import { report } from "./source";
import type { Store } from "./store";
import type { CameraControl, MonitorState } from "./types";

/** Questions a second; a question that is not answered holds back the next. */
const EVERY_MS = 60;

/** Steps of a slider of a camera's control. */
const STEPS = 1000;

/** A control whose range spans more than this factor has a logarithmic slider. */
const WIDE = 100;

export class Monitor {
  readonly element: HTMLElement;
  private readonly raw: HTMLCanvasElement;
  private readonly bars: HTMLCanvasElement;
  private readonly numbers: HTMLElement;
  private readonly warnings: HTMLElement;
  private readonly controls: HTMLElement;
  private readonly message: HTMLElement;
  private readonly recordButton: HTMLButtonElement;
  private readonly saveButton: HTMLButtonElement;
  private bitmap: Bitmap | null = null;
  private frameSnapshot = 0;
  private videoSnapshot = 0;
  /** From the arrival of a frame to the picture of its video on the screen. */
  private latencyMs: number | null = null;
  private isRecording = false;
  /** The controls that are shown, as text. */
  private shownControls = "";

  constructor(private readonly store: Store) {
    this.raw = h("canvas", { class: "raw-frame", id: "raw-frame", role: "img", "aria-label": "Raw frame" });
    this.bars = h("canvas", { class: "histogram", id: "exposure-histogram", role: "img", "aria-label": "Histogram of the raw frame" });
    this.numbers = h("dl", { class: "monitor-numbers", id: "monitor-numbers" });
    this.warnings = h("div", { id: "monitor-warnings" });
    this.controls = h("div", { id: "monitor-controls" });
    this.message = h("p", { class: "muted", id: "monitor-message", role: "status" });
    const button = (id: string, text: string, request: () => string) =>
      h("button", { type: "button", id, click: () => void this.ask(request()) }, text);
    this.recordButton = button("record", "Record", () => (this.isRecording ? "stop" : "record"));
    this.saveButton = button("save-full", "Save this frame and its full reconstruction", () => "save");
    this.element = h(
      "div",
      { class: "monitor" },
      h("figure", {}, this.raw, h("figcaption", {}, "Raw frame; saturated pixels are red")),
      this.bars,
      this.numbers,
      this.controls,
      h("div", { class: "row" }, this.recordButton, button("snapshot", "Keep this frame", () => "snapshot"), this.saveButton),
      this.message,
      this.warnings,
    );
    void this.poll();
  }

  private async ask(request: string): Promise<void> {
    await this.post(`api/monitor/request/${request}`);
  }

  private async post(path: string): Promise<void> {
    const answer = await fetch(path, { method: "POST" });
    if (!answer.ok) report(new Error(await answer.text()));
  }

  /** Sliders for what the camera lets be set, drawn anew where the camera has other values. */
  private showControls(controls: CameraControl[]): void {
    const text = JSON.stringify(controls);
    if (text === this.shownControls || this.controls.contains(document.activeElement)) return;
    this.shownControls = text;
    this.controls.replaceChildren(...controls.map((control) => this.slider(control)));
  }

  private slider(control: CameraControl): HTMLElement {
    const { name, value, min, max, unit } = control;
    const isWide = min > 0 && max / min > WIDE;
    const toPart = (v: number) => (isWide ? Math.log(v / min) / Math.log(max / min) : (v - min) / (max - min || 1));
    const toValue = (part: number) => (isWide ? min * (max / min) ** part : min + part * (max - min));
    // GenICam spells microseconds "us".
    const words = (v: number) => `${number(v, 4)}${unit ? ` ${unit === "us" ? "µs" : unit}` : ""}`;
    const shown = h("output", {}, words(value));
    const input = h("input", { type: "range", min: "0", max: String(STEPS), step: "1", "aria-label": name });
    input.value = String(Math.round(STEPS * toPart(value)));
    const chosen = () => toValue(Number(input.value) / STEPS);
    input.addEventListener("input", () => (shown.textContent = words(chosen())));
    input.addEventListener("change", () => {
      void this.post(`api/monitor/set/${encodeURIComponent(name)}/${chosen()}`);
      // From now on it shows what the camera has.
      input.blur();
      this.shownControls = "";
    });
    return h("label", { class: "control" }, h("span", {}, name), input, shown);
  }

  private async poll(): Promise<void> {
    try {
      for (;;) {
        const answer = await fetch("api/monitor");
        if (!answer.ok) throw new Error(await answer.text());
        const state = (await answer.json()) as MonitorState;
        this.show(state);
        if (state.frame_snapshot !== this.frameSnapshot) await this.fetchFrame(state);
        if (state.video_snapshot !== this.videoSnapshot) await this.fetchVideo(state.video_snapshot);
        await new Promise((resolve) => setTimeout(resolve, EVERY_MS));
      }
    } catch (error) {
      this.message.textContent = "The live view has ended.";
      report(error);
    }
  }

  private show(state: MonitorState): void {
    const { exposure, video } = state;
    const pairs: [name: string, value: string, kind?: string | undefined, id?: string][] = [];
    if (exposure) {
      const saturated = 100 * exposure.saturated_fraction;
      pairs.push(["Frame", String(exposure.number)]);
      pairs.push(["Saturated", `${number(saturated, 2)} %`, saturated > 0.1 ? "doubtful" : undefined]);
      pairs.push(["Mean, largest", `${number(exposure.mean, 3)}, ${exposure.max} of ${exposure.saturation_counts}`]);
      pairs.push(["Speckle contrast", exposure.contrast == null ? "–" : number(exposure.contrast, 3)]);
      pairs.push(["Grain", exposure.grain_px == null ? "–" : `${number(exposure.grain_px, 3)} px`]);
    }
    if (state.frames_per_second) pairs.push(["Frames a second", number(state.frames_per_second, 3)]);
    pairs.push(["Dropped, incomplete", `${state.dropped ?? 0}, ${state.incomplete ?? 0}`, state.dropped || state.incomplete ? "doubtful" : undefined]);
    if (video) {
      pairs.push(["Latency", this.latencyMs == null ? "–" : `${number(this.latencyMs, 3)} ms`, undefined, "latency"]);
      if (video.videos_per_second != null) pairs.push(["Videos a second", number(video.videos_per_second, 3)]);
      pairs.push(["Not reconstructed", `${state.skipped ?? 0} frames`]);
      pairs.push(["Residual/σ", number(video.residual_over_sigma, 3)]);
    }
    this.numbers.replaceChildren(...pairs.map(([name, value, kind, id]) => h("div", {}, h("dt", {}, name), h("dd", { class: kind, id }, value))));
    this.isRecording = state.recording != null;
    this.recordButton.textContent = this.isRecording ? `Stop (${state.recording} frames)` : "Record";
    this.recordButton.className = this.isRecording ? "accent" : "";
    this.saveButton.disabled = !state.reconstructs;
    this.message.textContent = [state.ended, state.message].filter(Boolean).join("; ");
    const warnings = [...(state.warnings ?? []), ...(state.error ? [state.error] : [])];
    this.warnings.replaceChildren(...warnings.map((text) => h("p", { class: "verdict doubtful" }, text)));
    if (exposure) this.drawBars(exposure.histogram);
    this.showControls(state.controls ?? []);
  }

  /** The histogram, its counts on a logarithmic scale. */
  private drawBars(counts: number[]): void {
    const { ctx, width, height } = fit(this.bars);
    ctx.clearRect(0, 0, width, height);
    const most = Math.log1p(Math.max(...counts));
    const step = width / counts.length;
    counts.forEach((count, i) => {
      const part = most > 0 ? Math.log1p(count) / most : 0;
      ctx.fillStyle = css(i === counts.length - 1 && count > 0 ? "--doubt" : "--accent");
      ctx.fillRect(i * step, height * (1 - part), Math.max(1, step - 1), height * part);
    });
  }

  private async fetchFrame(state: MonitorState): Promise<void> {
    const answer = await fetch("api/monitor/frame");
    if (!answer.ok) return;
    const [rows, columns] = (answer.headers.get("x-shape") ?? "").split(" ").map(Number);
    const counts = new Uint16Array(await answer.arrayBuffer());
    if (this.bitmap?.rows !== rows || this.bitmap.columns !== columns) this.bitmap = new Bitmap(rows, columns);
    const limit = state.exposure?.saturation_counts ?? 65535;
    const high = counts.reduce((a, b) => Math.max(a, b), 1);
    this.bitmap.values(counts, "grey", 0, high);
    // ABGR on a little-endian machine.
    for (let i = 0; i < counts.length; i++) if (counts[i] >= limit) this.bitmap.pixels[i] = 0xff2020e0;
    this.bitmap.done();
    this.raw.width = columns;
    this.raw.height = rows;
    this.raw.getContext("2d")!.drawImage(this.bitmap.canvas, 0, 0);
    this.frameSnapshot = state.frame_snapshot;
    if (!state.reconstructs) this.put(0, high, counts);
  }

  private async fetchVideo(snapshot: number): Promise<void> {
    const answer = await fetch("api/monitor/bins");
    if (!answer.ok) return;
    const [low, high] = (answer.headers.get("x-range") ?? "0 1").split(" ").map(Number);
    const sinceFrameMs = Number(answer.headers.get("x-since-frame-ms"));
    const answered = performance.now();
    this.put(low, high, new Uint16Array(await answer.arrayBuffer()));
    this.videoSnapshot = snapshot;
    // It is drawn in the next frame of the browser, and seen when the one after begins.
    requestAnimationFrame(() => requestAnimationFrame(() => (this.latencyMs = sinceFrameMs + performance.now() - answered)));
  }

  private put(low: number, high: number, numbers: Uint16Array): void {
    const { video } = this.store;
    const isRaw = this.videoSnapshot === 0 && video.bins === 1;
    video.low = low;
    video.step = isRaw ? 1 : (high - low) / (video.missing - 1);
    video.put(0, numbers);
    this.store.tell("data");
    this.store.tell("time");
  }
}
