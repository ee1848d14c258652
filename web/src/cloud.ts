// The bright points in space and time, to be turned by hand (the paper's Fig. 3f).

import { srgb, timeHue } from "./colour";
import { css, fit, h } from "./dom";
import type { Store } from "./store";
import { yieldToBrowser } from "./volume";

/** Points that a computer without a graphics card turns smoothly. */
const MAX_POINTS = 12_000;

export class Cloud {
  readonly element: HTMLElement;
  private readonly canvas: HTMLCanvasElement;
  private readonly status: HTMLElement;
  private points: Float32Array = new Float32Array();
  private count = 0;
  /** Turn about the time axis' normal, and tilt. */
  private turn = -0.6;
  private tilt = 0.35;
  private stale = true;
  private busy = false;
  private threshold = 0.3;

  constructor(private readonly store: Store) {
    this.canvas = h("canvas", {
      class: "cloud",
      tabindex: 0,
      role: "img",
      "aria-label": "Bright points in space and time; drag or use the arrow keys to turn it",
    });
    this.status = h("span", { class: "muted" });
    const level = h("input", {
      type: "range",
      id: "cloud-threshold",
      min: 2,
      max: 95,
      value: 30,
      "aria-label": "How bright a point must be, in per cent of white",
      input: () => {
        this.threshold = Number(level.value) / 100;
        this.stale = true;
        this.draw();
      },
    });
    this.element = h(
      "div",
      {},
      h("h3", {}, "Space and time"),
      this.canvas,
      h("div", { class: "row" }, h("label", { class: "choice" }, h("span", {}, "Brighter than"), level), this.status),
    );
    this.canvas.addEventListener("pointerdown", (event) => this.canvas.setPointerCapture(event.pointerId));
    this.canvas.addEventListener("pointermove", (event) => {
      if (!(event.buttons & 1)) return;
      this.rotate(event.movementX * 0.01, event.movementY * 0.01);
    });
    this.canvas.addEventListener("keydown", (event) => {
      const by: Record<string, [number, number]> = {
        ArrowLeft: [-0.1, 0],
        ArrowRight: [0.1, 0],
        ArrowUp: [0, -0.1],
        ArrowDown: [0, 0.1],
      };
      const turn = by[event.key];
      if (!turn) return;
      event.preventDefault();
      event.stopPropagation();
      this.rotate(...turn);
    });
    store.on((what) => {
      if (what === "data" || what === "look") this.stale = true;
      if (what !== "regions" && what !== "line") this.draw();
    });
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  private rotate(turn: number, tilt: number): void {
    this.turn += turn;
    this.tilt = Math.min(1.5, Math.max(-1.5, this.tilt + tilt));
    this.draw();
  }

  private async collect(): Promise<void> {
    const { video, state } = this.store;
    this.busy = true;
    this.stale = false;
    const value = state.low + this.threshold * (state.high - state.low);
    const wanted = Math.max(1, (value - video.low) / video.step);
    const least = Math.max(wanted, video.numberAbove(MAX_POINTS) + 1);
    const found: number[] = [];
    for (let t = 0; t < video.bins; t++) {
      if (!video.loaded[t]) continue;
      const bin = video.bin(t);
      for (let i = 0; i < bin.length; i++) {
        if (bin[i] >= least && bin[i] !== video.missing) {
          found.push(t, Math.floor(i / video.columns), i % video.columns, bin[i]);
        }
      }
      if (t % 16 === 15) await yieldToBrowser();
    }
    this.points = Float32Array.from(found);
    this.count = found.length / 4;
    const all = least > wanted ? ", the brightest above it" : "";
    this.status.textContent = `${Math.round(100 * this.threshold)} % of white: ${this.count} points${all}`;
    this.busy = false;
    this.draw();
  }

  draw(): void {
    if (this.element.offsetParent === null) return;
    if (this.stale && !this.busy) {
      void this.collect();
      return;
    }
    const { video, state, clock } = this.store;
    const { ctx, width, height } = fit(this.canvas);
    ctx.clearRect(0, 0, width, height);
    const side = Math.max(video.rows, video.columns);
    const size = Math.min(width, height * 1.35) * 0.47;
    const [ct, st, cp, sp] = [Math.cos(this.turn), Math.sin(this.turn), Math.cos(this.tilt), Math.sin(this.tilt)];
    // Time along the first axis, the picture's width along the second, its height downwards.
    const place = (t: number, y: number, x: number): [number, number, number] => {
      const a = (t / video.bins - 0.5) * 1.3;
      const b = (x - video.columns / 2) / side;
      const c = (y - video.rows / 2) / side;
      const depth = a * st + b * ct;
      const across = a * ct - b * st;
      return [width / 2 + size * across, height / 2 + size * (c * cp + depth * sp), depth * cp - c * sp];
    };
    this.drawBox(ctx, place);
    const order = Array.from({ length: this.count }, (_, i) => {
      const [t, y, x, n] = this.points.subarray(4 * i, 4 * i + 4);
      const [px, py, depth] = place(t + 0.5, y + 0.5, x + 0.5);
      return { px, py, depth, t, n };
    }).sort((a, b) => a.depth - b.depth);
    const top = (state.high - video.low) / video.step;
    const hues = Array.from({ length: video.bins }, (_, t) => srgb(timeHue(video.bins > 1 ? t / (video.bins - 1) : 0)));
    const dot = Math.max(1.5, (size / side) * 1.2);
    for (const { px, py, t, n } of order) {
      const [r, g, b] = hues[t];
      const now = t === state.t;
      ctx.globalAlpha = now ? 1 : Math.min(1, 0.25 + 0.6 * Math.min(1, n / top));
      ctx.fillStyle = now ? css("--ink") : `rgb(${r} ${g} ${b})`;
      ctx.beginPath();
      ctx.arc(px, py, dot / 2 + (now ? 0.5 : 0), 0, 2 * Math.PI);
      ctx.fill();
    }
    ctx.globalAlpha = 1;
    ctx.fillStyle = css("--muted");
    ctx.font = "12px system-ui, sans-serif";
    ctx.textAlign = "center";
    const name = (text: string, p: [number, number, number]) => ctx.fillText(text, p[0], p[1] + 16);
    const [start, end] = [clock.start, clock.end].map((time) => Number(time.toPrecision(4)));
    name(`time, ${start} to ${end} ${clock.unit}`, place(video.bins / 2, video.rows, 0));
    name("x (px)", place(video.bins, video.rows, video.columns / 2));
    ctx.fillText("y (px)", place(0, video.rows / 2, 0)[0] - 18, place(0, video.rows / 2, 0)[1]);
  }

  private drawBox(ctx: CanvasRenderingContext2D, place: (t: number, y: number, x: number) => [number, number, number]): void {
    const { video, state } = this.store;
    const [T, Y, X] = [video.bins, video.rows, video.columns];
    const path = (points: [number, number, number][]) => {
      ctx.beginPath();
      points.forEach(([px, py], i) => (i ? ctx.lineTo(px, py) : ctx.moveTo(px, py)));
      ctx.stroke();
    };
    ctx.strokeStyle = css("--rule");
    ctx.lineWidth = 1;
    for (const y of [0, Y]) {
      for (const x of [0, X]) path([place(0, y, x), place(T, y, x)]);
    }
    const frame = (t: number) => path([place(t, 0, 0), place(t, 0, X), place(t, Y, X), place(t, Y, 0), place(t, 0, 0)]);
    frame(0);
    frame(T);
    ctx.strokeStyle = css("--accent");
    ctx.lineWidth = 1.5;
    frame(state.t + 0.5);
  }
}
