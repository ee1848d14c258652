// Play, step, speed, loop and the slider of time; and the keys for them.

import { announce, choice, h } from "./dom";
import { grouped } from "./format";
import type { Store } from "./store";

const SPEEDS = [1, 2, 5, 10, 25, 50, 100];

export class Transport {
  readonly element: HTMLElement;
  private readonly slider: HTMLInputElement;
  private readonly play: HTMLButtonElement;
  private readonly time: HTMLOutputElement;
  private readonly loaded: HTMLProgressElement;
  private readonly slower: HTMLElement;
  private readonly loop: HTMLButtonElement;
  /** Bins that have been played but not yet shown. */
  private rest = 0;
  private last = 0;

  constructor(private readonly store: Store) {
    const { state, clock } = store;
    const last = clock.bins - 1;
    this.slider = h("input", {
      type: "range",
      id: "scrub",
      min: 0,
      max: last,
      step: 1,
      value: 0,
      "aria-label": "Time",
      input: () => store.goTo(Number(this.slider.value)),
    });
    this.play = this.button("Play (space)", "▶", () => this.toggle(), "play");
    this.loop = this.button("Loop (L)", "⟳", () => this.toggleLoop(), "loop");
    this.loop.setAttribute("aria-pressed", String(state.loop));
    this.time = h("output", { id: "time", for: "scrub" });
    this.loaded = h("progress", { max: clock.bins, value: 0, "aria-label": "Part of the video that is loaded" });
    this.slower = h("span", { class: "muted", id: "slower" });
    this.element = h(
      "section",
      { class: "transport", "aria-label": "Playback" },
      h("div", { class: "scrub" }, this.slider, this.loaded),
      h(
        "div",
        { class: "buttons" },
        this.button("First bin (Home)", "❘◀", () => store.goTo(0), "first"),
        this.button("Step back (←)", "◀", () => this.step(-1), "back"),
        this.play,
        this.button("Step forward (→)", "▶❘", () => this.step(1), "forward"),
        this.loop,
        this.time,
        h("span", { class: "spring" }),
        choice(
          "Speed",
          SPEEDS.map((s) => [String(s), `${s} bins/s`] as [string, string]),
          String(state.speed),
          (value) => {
            store.state.speed = Number(value);
            this.showTime();
          },
          "speed",
        ),
        this.slower,
      ),
    );
    if (last === 0) this.element.hidden = true;
    this.showTime();
    store.on((what) => {
      if (what === "time") this.show();
      if (what === "data") this.loaded.value = store.video.count;
      this.loaded.hidden = store.video.isWhole;
    });
    this.show();
    document.addEventListener("keydown", (event) => this.key(event));
  }

  private button(label: string, text: string, click: () => void, id: string): HTMLButtonElement {
    const name = label.replace(/ \(.*/, "");
    return h("button", { type: "button", class: "icon", id, title: label, "aria-label": name, click }, text);
  }

  private showTime(): void {
    const { clock, state } = this.store;
    if (clock.step_us == null) return;
    const times = 1e6 / clock.step_us / state.speed;
    this.slower.textContent = `${grouped(times)} × slower`;
  }

  private show(): void {
    const { clock, state } = this.store;
    this.slider.value = String(state.t);
    const text = `${clock.label(state.t)}`;
    this.slider.setAttribute("aria-valuetext", text);
    this.time.textContent = `${text} · ${state.t + 1} of ${clock.bins}`;
    if (!state.playing) announce(text);
  }

  toggle(): void {
    const { store } = this;
    const playing = !store.state.playing;
    const atEnd = store.state.t === store.clock.bins - 1;
    if (playing && atEnd) store.goTo(0);
    store.state.playing = playing;
    this.play.textContent = playing ? "❚❚" : "▶";
    this.play.setAttribute("aria-label", playing ? "Pause" : "Play");
    this.play.classList.toggle("on", playing);
    this.rest = 0;
    this.last = performance.now();
    if (playing) requestAnimationFrame((now) => this.tick(now));
    else this.show();
  }

  private tick(now: number): void {
    const { store } = this;
    if (!store.state.playing) return;
    // A tab that was hidden does not run ahead.
    this.rest += (Math.min(250, Math.max(0, now - this.last)) / 1000) * store.state.speed;
    this.last = now;
    const steps = Math.floor(this.rest);
    if (steps > 0) {
      this.rest -= steps;
      const next = store.state.t + steps;
      if (next >= store.clock.bins && !store.state.loop) {
        store.goTo(store.clock.bins - 1);
        this.toggle();
        return;
      }
      store.goTo(next % store.clock.bins);
    }
    requestAnimationFrame((later) => this.tick(later));
  }

  private step(by: number): void {
    if (this.store.state.playing) this.toggle();
    this.store.goTo(this.store.state.t + by);
  }

  private toggleLoop(): void {
    const loop = !this.store.state.loop;
    this.store.state.loop = loop;
    this.loop.setAttribute("aria-pressed", String(loop));
  }

  private key(event: KeyboardEvent): void {
    const target = event.target as HTMLElement;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (target.closest("input, select, textarea, summary")) return;
    // Arrows go from tab to tab.
    if (target.closest("[role=tab]") && event.key.startsWith("Arrow")) return;
    const by = event.shiftKey ? 10 : 1;
    const keys: Record<string, () => void> = {
      ArrowLeft: () => this.step(-by),
      ArrowRight: () => this.step(by),
      Home: () => this.step(-Infinity),
      End: () => this.step(Infinity),
      l: () => this.toggleLoop(),
    };
    if (!target.closest("button")) keys[" "] = () => this.toggle();
    const act = keys[event.key];
    if (act) {
      event.preventDefault();
      act();
    }
  }
}
