// Play, step, speed, repeat, the slider of time, the part that is played, bookmarks; and the keys for them.

import { announce, choice, h } from "./dom";
import { grouped } from "./format";
import type { Keys } from "./keys";
import type { Repeat, Store } from "./store";

const SPEEDS = [1, 2, 5, 10, 25, 50, 100];
const REPEATS: [Repeat, string][] = [
  ["once", "once"],
  ["loop", "again and again"],
  ["ping-pong", "to and fro"],
];
/** Steps with Shift, in steps without. */
const LONG = 10;

export class Transport {
  readonly element: HTMLElement;
  private readonly slider: HTMLInputElement;
  private readonly play: HTMLButtonElement;
  private readonly time: HTMLOutputElement;
  private readonly loaded: HTMLProgressElement;
  private readonly slower: HTMLElement;
  private readonly marks: HTMLElement;
  private readonly part: HTMLElement;
  private readonly bookmark: HTMLButtonElement;
  /** Bins that have been played but not yet shown. */
  private rest = 0;
  private last = 0;
  private direction: 1 | -1 = 1;

  constructor(
    private readonly store: Store,
    keys: Keys,
  ) {
    const { clock } = store;
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
    this.time = h("output", { id: "time", for: "scrub", title: store.axesWords });
    this.loaded = h("progress", { max: clock.bins, value: 0, "aria-label": "Part of the video that is loaded" });
    this.slower = h("span", { class: "muted", id: "slower" });
    this.marks = h("div", { class: "marks", "aria-hidden": "true" });
    this.part = h("span", { class: "muted", id: "part", role: "status" });
    this.bookmark = this.button("Bookmark (B)", "☆", () => this.toggleBookmark(), "bookmark");
    this.element = h(
      "section",
      { class: "transport", "aria-label": "Playback" },
      h("div", { class: "scrub" }, this.marks, this.slider, this.loaded),
      this.playback(),
      this.parts(),
    );
    if (last === 0) this.element.hidden = true;
    this.showSpeed();
    store.on((what) => {
      if (what === "time" || what === "marks") this.show();
      if (what === "marks") this.showMarks();
      if (what === "data") this.loaded.value = store.video.count;
      this.loaded.hidden = store.video.isWhole;
    });
    this.show();
    this.showMarks();
    this.bind(keys);
  }

  private playback(): HTMLElement {
    const { store } = this;
    return h(
      "div",
      { class: "buttons" },
      this.button("First bin (Home)", "❘◀", () => store.goTo(store.state.first), "first"),
      this.button("Step back (←)", "◀", () => this.step(-1), "back"),
      this.play,
      this.button("Step forward (→)", "▶❘", () => this.step(1), "forward"),
      this.time,
      h("span", { class: "spring" }),
      choice(
        "Speed",
        SPEEDS.map((s) => [String(s), `${s} bins/s`] as [string, string]),
        String(store.state.speed),
        (value) => {
          store.state.speed = Number(value);
          this.showSpeed();
        },
        "speed",
      ),
      this.slower,
    );
  }

  /** What is repeated, from where to where, by which step, and the bookmarks. */
  private parts(): HTMLElement {
    const { store } = this;
    const step = h("input", {
      type: "number",
      class: "number",
      id: "step",
      min: 1,
      max: store.clock.bins,
      step: 1,
      value: store.state.step,
      change: () => {
        store.state.step = Math.min(store.clock.bins, Math.max(1, Math.round(Number(step.value)) || 1));
        step.value = String(store.state.step);
      },
    });
    return h(
      "div",
      { class: "buttons parts" },
      choice("Repeat", REPEATS, store.state.repeat, (repeat) => this.setRepeat(repeat), "repeat"),
      h("label", { class: "choice" }, h("span", {}, "Step"), step),
      this.button("Play and save from here (I)", "[", () => this.setIn(), "in-point"),
      this.button("Play and save up to here (O)", "]", () => this.setOut(), "out-point"),
      this.button("Play and save all (X)", "×", () => this.setPart(0, store.clock.bins - 1), "clear-points"),
      this.part,
      this.bookmark,
      this.button("Bookmark before (,)", "‹", () => this.toBookmark(-1), "previous-bookmark"),
      this.button("Next bookmark (.)", "›", () => this.toBookmark(1), "next-bookmark"),
    );
  }

  private bind(keys: Keys): void {
    const group = "Time";
    const steps = (by: number) => (event: KeyboardEvent) => this.step(event.shiftKey ? LONG * by : by);
    keys.add(group, "Space", "plays and pauses", { " ": () => this.toggle() });
    keys.add(group, "←  →", "a step back, on; with Shift ten", { ArrowLeft: steps(-1), ArrowRight: steps(1) });
    keys.add(group, "Home  End", "the first bin, the last", {
      Home: () => this.step(-Infinity),
      End: () => this.step(Infinity),
    });
    keys.add(group, "L", "once, again and again, to and fro", {
      l: () => {
        const at = REPEATS.findIndex(([name]) => name === this.store.state.repeat);
        this.setRepeat(REPEATS[(at + 1) % REPEATS.length][0]);
      },
    });
    keys.add(group, "I  O  X", "play and save from here, up to here, all", {
      i: () => this.setIn(),
      o: () => this.setOut(),
      x: () => this.setPart(0, this.store.clock.bins - 1),
    });
    keys.add(group, "B", "sets or takes away a bookmark", { b: () => this.toggleBookmark() });
    keys.add(group, ",  .", "the bookmark before, the next", { ",": () => this.toBookmark(-1), ".": () => this.toBookmark(1) });
  }

  private button(label: string, text: string, click: () => void, id: string): HTMLButtonElement {
    const name = label.replace(/ \(.*/, "");
    return h("button", { type: "button", class: "icon", id, title: label, "aria-label": name, click }, text);
  }

  private showSpeed(): void {
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
    const isMarked = state.bookmarks.includes(state.t);
    this.bookmark.textContent = isMarked ? "★" : "☆";
    this.bookmark.setAttribute("aria-pressed", String(isMarked));
    if (!state.playing) announce(text);
  }

  /** The part and the bookmarks, above the slider. */
  private showMarks(): void {
    const { clock, state } = this.store;
    const at = (t: number) => (clock.bins > 1 ? t / (clock.bins - 1) : 0);
    const place = (element: HTMLElement, left: number, width?: number) => {
      // The middle of a slider's thumb does not reach its ends.
      element.style.left = `calc(8px + ${left} * (100% - 16px))`;
      if (width !== undefined) element.style.width = `calc(${width} * (100% - 16px))`;
      return element;
    };
    const isAll = state.first === 0 && state.last === clock.bins - 1;
    const part = isAll ? [] : [place(h("span", { class: "part" }), at(state.first), at(state.last) - at(state.first))];
    this.marks.replaceChildren(...part, ...state.bookmarks.map((t) => place(h("span", { class: "bookmark" }), at(t))));
    this.part.textContent = isAll ? "" : `${state.first + 1} to ${state.last + 1}`;
  }

  private setRepeat(repeat: Repeat): void {
    this.store.state.repeat = repeat;
    this.direction = 1;
    (document.getElementById("repeat") as HTMLSelectElement).value = repeat;
    announce(`Repeat: ${repeat}`);
  }

  private setIn(): void {
    const { t, last } = this.store.state;
    this.setPart(t, Math.max(t, last));
  }

  private setOut(): void {
    const { t, first } = this.store.state;
    this.setPart(Math.min(t, first), t);
  }

  private setPart(first: number, last: number): void {
    this.store.set({ first, last }, "marks");
  }

  private toggleBookmark(): void {
    const { t, bookmarks } = this.store.state;
    const others = bookmarks.filter((b) => b !== t);
    const kept = others.length < bookmarks.length ? others : [...others, t].sort((a, b) => a - b);
    this.store.set({ bookmarks: kept }, "marks");
  }

  private toBookmark(by: 1 | -1): void {
    const { t, bookmarks } = this.store.state;
    const next = by > 0 ? bookmarks.find((b) => b > t) : [...bookmarks].reverse().find((b) => b < t);
    if (next !== undefined) this.store.goTo(next);
  }

  toggle(): void {
    const { store } = this;
    const playing = !store.state.playing;
    const { t, first, last } = store.state;
    if (playing && (t >= last || t < first)) store.goTo(first);
    this.direction = 1;
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
      const next = after(store.state, this.direction, steps * store.state.step);
      this.direction = next.direction;
      store.goTo(next.t);
      if (next.isEnd) {
        this.toggle();
        return;
      }
    }
    requestAnimationFrame((later) => this.tick(later));
  }

  private step(by: number): void {
    if (this.store.state.playing) this.toggle();
    this.store.goTo(this.store.state.t + by * this.store.state.step);
  }
}

interface Playing {
  t: number;
  first: number;
  last: number;
  repeat: Repeat;
}

/** The bin that is played `by` bins later, in which direction it goes on, and whether that is the end. */
export function after({ t, first, last, repeat }: Playing, direction: 1 | -1, by: number): { t: number; direction: 1 | -1; isEnd: boolean } {
  const length = last - first + 1;
  if (length <= 1) return { t: first, direction: 1, isEnd: repeat === "once" };
  const at = Math.min(length - 1, Math.max(0, t - first));
  if (repeat === "loop") return { t: first + ((at + by) % length), direction: 1, isEnd: false };
  if (repeat === "once") return { t: Math.min(last, first + at + by), direction: 1, isEnd: at + by >= length };
  // To and fro: a path of twice the length, without its ends twice.
  const way = 2 * (length - 1);
  const on = ((direction > 0 ? at : way - at) + by) % way;
  return on < length - 1 ? { t: first + on, direction: 1, isEnd: false } : { t: first + way - on, direction: -1, isEnd: false };
}
