// Brightness limits over the histogram of the video, and the colour map.

import { colourOf, type MapName } from "./colour";
import { choice, css, fit, h } from "./dom";
import { number } from "./format";
import type { Store } from "./store";

const BARS = 96;

export class Limits {
  readonly element: HTMLElement;
  private readonly canvas: HTMLCanvasElement;
  private readonly low: HTMLInputElement;
  private readonly high: HTMLInputElement;
  private readonly status: HTMLElement;
  private isOwn = true;

  constructor(private readonly store: Store) {
    this.canvas = h("canvas", { class: "histogram", role: "img", "aria-label": "Histogram of the video's brightness" });
    const slider = (id: string, label: string) =>
      h("input", {
        type: "range",
        id,
        min: 0,
        max: 1000,
        step: 1,
        "aria-label": label,
        input: () => {
          this.isOwn = false;
          this.read(id === "low");
        },
      });
    this.low = slider("low", "Value shown as black");
    this.high = slider("high", "Value shown as white");
    this.status = h("span", { class: "muted", id: "limits" });
    const maps: [MapName, string][] = [
      ["magma", "Magma"],
      ["viridis", "Viridis"],
      ["grey", "Grey"],
    ];
    this.element = h(
      "section",
      { class: "limits", "aria-label": "Brightness" },
      h("div", { class: "bars" }, this.canvas, this.low, this.high),
      h(
        "div",
        { class: "row" },
        choice("Colours", maps, store.state.map, (map) => store.set({ map }, "look"), "map"),
        h(
          "button",
          {
            type: "button",
            class: "quiet",
            id: "auto-limits",
            click: () => {
              this.isOwn = true;
              this.auto();
            },
          },
          "Auto",
        ),
        this.status,
      ),
    );
    this.auto();
    store.on((what) => {
      if (what === "data" && this.isOwn) this.auto();
      if (what === "look" || what === "data") this.draw();
    });
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  private auto(): void {
    const { video } = this.store;
    this.store.set({ low: Math.max(0, video.low), high: video.whitePoint() }, "look");
  }

  private fraction(value: number): number {
    const { video } = this.store;
    return (value - video.low) / (video.high - video.low);
  }

  private read(isLow: boolean): void {
    const { video } = this.store;
    let [low, high] = [Number(this.low.value), Number(this.high.value)];
    if (isLow) low = Math.min(low, high - 5);
    else high = Math.max(high, low + 5);
    const value = (v: number) => video.low + (v / 1000) * (video.high - video.low);
    this.store.set({ low: value(low), high: value(high) }, "look");
  }

  private draw(): void {
    const { state, video } = this.store;
    const { ctx, width, height } = fit(this.canvas);
    ctx.clearRect(0, 0, width, height);
    const counts = video.histogram();
    const bars = new Float64Array(BARS);
    const top = video.missing - 1;
    for (let n = 1; n <= top; n++) bars[Math.min(BARS - 1, Math.floor((n / top) * BARS))] += counts[n];
    const logs = Array.from(bars, (b) => Math.log1p(b));
    const most = Math.max(1, ...logs);
    const [a, b] = [this.fraction(state.low), this.fraction(state.high)];
    for (let i = 0; i < BARS; i++) {
      const f = (i + 0.5) / BARS;
      const tall = (logs[i] / most) * (height - 8);
      const [r, g, bl] = colourOf(state.map, Math.min(1, Math.max(0, (f - a) / (b - a || 1))));
      ctx.fillStyle = f < a || f > b ? css("--rule") : `rgb(${r} ${g} ${bl})`;
      ctx.fillRect((i * width) / BARS, height - tall, width / BARS - 0.5, tall);
    }
    ctx.fillStyle = css("--rule");
    ctx.fillRect(0, height - 1, width, 1);
    this.low.value = String(Math.round(1000 * a));
    this.high.value = String(Math.round(1000 * b));
    this.status.textContent = `${number(state.low, 3)} to ${number(state.high, 3)} counts`;
  }
}
