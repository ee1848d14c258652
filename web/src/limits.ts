// Brightness limits over the histogram of the video, by hand or by number; the colour map and its scale.

import { colourOf, MAPS, shadeOf, type Scale } from "./colour";
import { choice, css, fit, h, notify } from "./dom";
import { number } from "./format";
import type { Keys } from "./keys";
import type { Store } from "./store";

const BARS = 96;
/** Least distance of the limits, as a part of the values' range. */
const MIN_WIDTH = 0.005;
const [MIN_GAMMA, MAX_GAMMA] = [0.1, 5];

export class Limits {
  readonly element: HTMLElement;
  private readonly canvas: HTMLCanvasElement;
  private readonly low: HTMLInputElement;
  private readonly high: HTMLInputElement;
  private readonly lowNumber: HTMLInputElement;
  private readonly highNumber: HTMLInputElement;
  private readonly gamma: HTMLInputElement;
  private readonly status: HTMLElement;
  private isOwn = true;

  constructor(
    private readonly store: Store,
    keys: Keys,
  ) {
    this.canvas = h("canvas", { class: "histogram", role: "img", "aria-label": "Histogram of the video's brightness" });
    const slider = (id: string, label: string) =>
      h("input", { type: "range", id, min: 0, max: 1000, step: 1, "aria-label": label, input: () => this.slide(id === "low") });
    this.low = slider("low", "Value shown as black");
    this.high = slider("high", "Value shown as white");
    const field = (id: string, label: string) =>
      h("input", { type: "number", class: "number", id, step: "any", "aria-label": label, change: () => this.type() });
    this.lowNumber = field("low-number", "Value shown as black, as a number");
    this.highNumber = field("high-number", "Value shown as white, as a number");
    this.status = h("span", { class: "unseen", id: "limits" });
    this.gamma = h("input", {
      type: "number",
      class: "number",
      id: "gamma",
      min: MIN_GAMMA,
      max: MAX_GAMMA,
      step: 0.1,
      value: store.state.scale.gamma,
      hidden: true,
      "aria-label": "Gamma",
      title: "Gamma: below 1 what is dark becomes brighter",
      input: () => {
        const gamma = Number(this.gamma.value);
        if (gamma >= MIN_GAMMA && gamma <= MAX_GAMMA) this.setScale({ gamma });
      },
    });
    this.element = h(
      "section",
      { class: "limits", "aria-label": "Brightness" },
      h("div", { class: "bars" }, this.canvas, this.low, this.high),
      h(
        "div",
        { class: "row" },
        this.lowNumber,
        h("span", { class: "muted" }, "to"),
        this.highNumber,
        h("span", { class: "muted" }, store.unit),
        h("button", { type: "button", class: "quiet", id: "auto-limits", title: "Limits from the video (A)", click: () => this.reset() }, "Auto"),
        h("span", { class: "spring" }),
        choice("Colours", MAPS, store.state.map, (map) => store.set({ map }, "look"), "map"),
        this.scales(),
        this.gamma,
        this.status,
      ),
    );
    this.auto();
    store.on((what) => {
      if (what === "data" && this.isOwn) this.auto();
      if (what === "look" || what === "data") this.draw();
    });
    new ResizeObserver(() => this.draw()).observe(this.canvas);
    this.bind(keys);
  }

  private bind(keys: Keys): void {
    const { store } = this;
    const move = (part: number) => () => {
      const { low, high } = store.state;
      this.take(low, high * part);
    };
    keys.add("Brightness", "A", "limits from the video", { a: () => this.reset() });
    keys.add("Brightness", "[  ]", "brighter, darker", { "[": move(1 / 1.15), "]": move(1.15) });
    keys.add("Brightness", "C", "the next colour map", {
      c: () => {
        const at = MAPS.findIndex(([name]) => name === store.state.map);
        const [map] = MAPS[(at + 1) % MAPS.length];
        (document.getElementById("map") as HTMLSelectElement).value = map;
        store.set({ map }, "look");
      },
    });
    keys.add("Brightness", "G", "linear, gamma, logarithmic", {
      g: () => {
        const kinds: Scale["kind"][] = ["linear", "gamma", "log"];
        const kind = kinds[(kinds.indexOf(store.state.scale.kind) + 1) % kinds.length];
        (document.getElementById("scale") as HTMLSelectElement).value = kind;
        this.setScale({ kind });
      },
    });
  }

  private scales(): HTMLElement {
    const kinds: [Scale["kind"], string][] = [
      ["linear", "Linear"],
      ["gamma", "Gamma"],
      ["log", "Log, 3 decades"],
    ];
    return choice("Scale", kinds, this.store.state.scale.kind, (kind) => this.setScale({ kind }), "scale");
  }

  private setScale(change: Partial<Scale>): void {
    this.store.set({ scale: { ...this.store.state.scale, ...change } }, "look");
    this.gamma.hidden = this.store.state.scale.kind !== "gamma";
  }

  private reset(): void {
    this.isOwn = true;
    this.auto();
  }

  private auto(): void {
    const { video } = this.store;
    this.store.set({ low: Math.max(0, video.low), high: video.whitePoint() }, "look");
  }

  private fraction(value: number): number {
    const { video } = this.store;
    return (value - video.low) / (video.high - video.low);
  }

  /** Takes limits that the user has chosen. */
  private take(low: number, high: number): void {
    this.isOwn = false;
    this.store.set({ low, high }, "look");
  }

  private slide(isLow: boolean): void {
    const { video } = this.store;
    let [low, high] = [Number(this.low.value), Number(this.high.value)];
    if (isLow) low = Math.min(low, high - 1000 * MIN_WIDTH);
    else high = Math.max(high, low + 1000 * MIN_WIDTH);
    const value = (v: number) => video.low + (v / 1000) * (video.high - video.low);
    this.take(value(low), value(high));
  }

  private type(): void {
    const [low, high] = [this.lowNumber, this.highNumber].map((field) => (field.value.trim() === "" ? NaN : Number(field.value)));
    if (!Number.isFinite(low) || !Number.isFinite(high) || low >= high) {
      notify(`The limits ${this.lowNumber.value || "–"} to ${this.highNumber.value || "–"} are not kept: black has to be below white.`);
      this.store.tell("look");
      return;
    }
    this.take(low, high);
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
      const [r, g, bl] = colourOf(state.map, shadeOf((f - a) / (b - a || 1), state.scale));
      ctx.fillStyle = f < a || f > b ? css("--rule") : `rgb(${r} ${g} ${bl})`;
      ctx.fillRect((i * width) / BARS, height - tall, width / BARS - 0.5, tall);
    }
    ctx.fillStyle = css("--rule");
    ctx.fillRect(0, height - 1, width, 1);
    this.low.value = String(Math.round(1000 * a));
    this.high.value = String(Math.round(1000 * b));
    const shown = (field: HTMLInputElement, value: number) => {
      if (document.activeElement !== field || this.isOwn) field.value = String(Number(value.toPrecision(4)));
    };
    shown(this.lowNumber, state.low);
    shown(this.highNumber, state.high);
    this.status.textContent = `${number(state.low, 3)} to ${number(state.high, 3)} ${this.store.unit}`;
  }
}
