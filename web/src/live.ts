// A reconstruction that is running.

import { Chart } from "./chart";
import { announce, h } from "./dom";
import { drawConvergence } from "./evidence";
import { number } from "./format";
import { report } from "./source";
import type { Store } from "./store";
import type { LiveState } from "./types";

const EVERY_MS = 300;

export class Live {
  readonly element: HTMLElement;
  private readonly status: HTMLElement;
  private readonly bar: HTMLProgressElement;
  private readonly stop: HTMLButtonElement;
  private readonly chart: Chart;
  private snapshot = 0;

  constructor(private readonly store: Store) {
    this.status = h("p", { class: "progress-words", id: "live-words" }, "Setting up …");
    this.bar = h("progress", { "aria-label": "Iterations" });
    this.stop = h(
      "button",
      { type: "button", id: "stop", class: "accent", click: () => void this.ask() },
      "Stop and keep the current result",
    );
    this.chart = new Chart({ label: "Convergence", x: "time (s)", y: "residual/σ", right: "PSNR (dB)", height: 260, log: true });
    this.element = h("div", { class: "live" }, this.status, this.bar, this.chart.element, this.stop);
    void this.poll();
  }

  private async ask(): Promise<void> {
    this.stop.disabled = true;
    await fetch("api/live/stop", { method: "POST" }).catch(report);
  }

  private async poll(): Promise<void> {
    try {
      for (;;) {
        const answer = await fetch("api/live");
        if (!answer.ok) throw new Error(await answer.text());
        const state = (await answer.json()) as LiveState;
        if (state.stage === "done") {
          location.reload();
          return;
        }
        if (state.stage === "failed") throw new Error(state.error ?? "The reconstruction failed.");
        this.show(state);
        if (state.snapshot !== this.snapshot) await this.fetch(state.snapshot);
        await new Promise((resolve) => setTimeout(resolve, EVERY_MS));
      }
    } catch (error) {
      this.stop.disabled = true;
      this.status.textContent = "The reconstruction has ended.";
      report(error);
    }
  }

  private show(state: LiveState): void {
    const last = state.course.at(-1);
    const stages = { running: "", stopping: "Stopping … ", writing: "Writing the result … ", done: "", failed: "" };
    const label = state.label ? `${state.label}: ` : "";
    const text = last
      ? `${stages[state.stage]}${label}iteration ${last[0]} of at most ${state.max_iterations}, ${number(last[1], 3)} s, residual/σ ${number(last[2], 3)}${last[3] == null ? "" : `, PSNR ${number(last[3], 3)} dB`}`
      : "Setting up …";
    this.status.textContent = text;
    if (state.stage !== "running") {
      this.stop.disabled = true;
      announce(text);
    }
    if (last && state.max_iterations) {
      this.bar.max = state.max_iterations;
      this.bar.value = last[0];
    }
    const every = Math.ceil(state.course.length / 400);
    const points = state.course.filter((_, i) => i % every === 0 || i === state.course.length - 1);
    if (points.length > 1) {
      drawConvergence(
        this.chart,
        points.map(([iteration, seconds, residual_over_sigma, psnr_db]) => ({ iteration, seconds, residual_over_sigma, psnr_db })),
      );
    }
  }

  private async fetch(snapshot: number): Promise<void> {
    const answer = await fetch("api/live/bins");
    if (!answer.ok) return;
    const [low, high] = (answer.headers.get("x-range") ?? "0 1").split(" ").map(Number);
    const numbers = new Uint16Array(await answer.arrayBuffer());
    const { video } = this.store;
    video.low = low;
    video.step = (high - low) / (video.missing - 1);
    video.put(0, numbers);
    this.snapshot = snapshot;
    this.store.tell("data");
    this.store.tell("time");
  }
}
