// What is shown: one state, and those who draw it.

import type { MapName, Scale } from "./colour";
import type { Meta, Rect } from "./types";
import { Clock, number } from "./format";
import { Coverage } from "./masks";
import type { Source } from "./source";
import type { Volume } from "./volume";

export interface Region extends Rect {
  id: number;
  /** As the report counts it. */
  number: number;
  colour: string;
  /** Empty where the user gave none. */
  name: string;
}

/** Length of a pixel, and where. */
export interface Pitch {
  um: number;
  place: "at the sensor" | "at the object";
}

export interface Line {
  x0: number;
  y0: number;
  x1: number;
  y1: number;
}

export type Layer = "video" | "time" | "peak";
export type Comparison = "none" | "truth" | "difference" | "change" | "other";
export type Tool = "trace" | "line" | "move" | "probe";
export type Repeat = "once" | "loop" | "ping-pong";

export interface State {
  t: number;
  playing: boolean;
  /** Bins a second. */
  speed: number;
  repeat: Repeat;
  /** Bins of a step. */
  step: number;
  /** First and last bin of what is played and saved. */
  first: number;
  last: number;
  /** Bins to come back to, in their order. */
  bookmarks: number[];
  map: MapName;
  scale: Scale;
  low: number;
  high: number;
  layer: Layer;
  comparison: Comparison;
  zoom: number;
  /** Middle of what is seen, in pixels of the video. */
  cx: number;
  cy: number;
  tool: Tool;
  regions: Region[];
  /** The id of the region that keys act on. */
  selected: number | null;
  line: Line | null;
  /** The pixel whose value is shown. */
  probe: { y: number; x: number } | null;
  /** Whether saved pictures have the time, regions and scale bar, and a colour bar. */
  stamp: boolean;
  overlays: boolean;
  colourBar: boolean;
}

/** What has changed: listeners draw only what it touches. */
export type Change = "time" | "look" | "regions" | "line" | "data" | "probe" | "marks";

export class Store {
  readonly meta: Meta;
  readonly clock: Clock;
  readonly video: Volume;
  readonly truth: Volume | null;
  readonly other: Volume | null;
  readonly otherClock: Clock | null;
  /** What the frame observes, and the other result's; null where that is all. */
  readonly coverage: Coverage | null;
  readonly otherCoverage: Coverage | null;
  state: State;
  private readonly listeners: ((what: Change) => void)[] = [];
  private dirty = new Set<Change>();

  constructor(
    readonly source: Source,
    volumes: { video: Volume; truth: Volume | null; other: Volume | null },
    masks: { coverage: Volume | null; otherCoverage: Volume | null },
  ) {
    const [meta, second] = source.results;
    this.meta = meta;
    this.clock = new Clock(meta.shape[0], meta.bin_duration_us, meta.view?.start_us);
    this.video = volumes.video;
    this.truth = volumes.truth;
    this.other = volumes.other;
    this.coverage = masks.coverage && new Coverage(masks.coverage, meta.view?.coverage_fraction ?? null);
    this.otherCoverage = masks.otherCoverage && new Coverage(masks.otherCoverage, second.view?.coverage_fraction ?? null);
    // A video alone has no clock of its own: with as many bins it takes that of the result.
    this.otherClock = second
      ? new Clock(
          second.shape[0],
          second.bin_duration_us ??
            (meta.bin_duration_us == null ? null : (meta.bin_duration_us * meta.shape[0]) / second.shape[0]),
          second.bin_duration_us == null ? this.clock.start : second.view?.start_us,
        )
      : null;
    this.state = {
      t: 0,
      playing: false,
      speed: meta.shape[0] > 120 ? 25 : 10,
      repeat: "loop",
      step: 1,
      first: 0,
      last: meta.shape[0] - 1,
      bookmarks: [],
      map: "magma",
      scale: { kind: "linear", gamma: 0.5 },
      low: 0,
      high: this.video.high,
      layer: "video",
      comparison: this.other ? "other" : this.truth ? "truth" : "none",
      zoom: 1,
      cx: meta.shape[2] / 2,
      cy: meta.shape[1] / 2,
      tool: "trace",
      regions: [],
      selected: null,
      line: null,
      probe: null,
      stamp: true,
      overlays: true,
      colourBar: false,
    };
  }

  /** Bin of the other result at the time of bin `t`. */
  otherBinAt(t: number): number {
    if (!this.otherClock) return t;
    const hasTime = this.clock.step_us != null && this.otherClock.step_us != null;
    return hasTime ? this.otherClock.bin(this.clock.at(t)) : Math.min(t, this.otherClock.bins - 1);
  }

  /** How many times as bright the other result is where the two cannot be shown on one scale, else 1. */
  get otherRatio(): number {
    if (!this.other) return 1;
    const ratio = this.other.high / this.video.high;
    const isAlike = !Number.isFinite(ratio) || ratio <= 0 || (ratio > 0.25 && ratio < 4);
    return isAlike ? 1 : ratio;
  }

  /** Brightness limits of the other result: those of this one where they can be compared. */
  get otherLimits(): [number, number] {
    const { low, high } = this.state;
    return [low * this.otherRatio, high * this.otherRatio];
  }

  /** The unit of the values. */
  get unit(): string {
    return this.meta.view?.unit ?? "counts";
  }

  /** µm of one pixel, and where; null where the pitch is not known. */
  get pitch(): Pitch | null {
    const { pixel_pitch_um: um, magnification } = this.meta.view ?? {};
    if (um == null) return null;
    return magnification ? { um: um / magnification, place: "at the object" } : { um, place: "at the sensor" };
  }

  /** A value with its unit, in electrons too where the gain is known. */
  valueWords(value: number, { view }: Meta = this.meta): string {
    const gain = this.unit === "counts" ? view?.gain_electrons_per_count : null;
    return `${number(value, 4)} ${this.unit}${gain ? ` (${number(value * gain, 4)} electrons)` : ""}`;
  }

  /** Where the zero of time is and what a count is, in words; empty for a video without a camera. */
  get axesWords(): string {
    const { view } = this.meta;
    if (view?.start_us == null || this.clock.step_us == null) return "";
    const delay = view.trigger_delay_us;
    const zero = `t = 0 is the start of exposure of the row that is read first${delay == null ? "" : `, ${number(delay, 6)} µs after the trigger`}.`;
    if (this.unit !== "counts") return zero;
    const gain = view.gain_electrons_per_count;
    const electrons = gain ? ` (1 count is ${number(gain, 3)} electrons)` : "";
    return `${zero} Light is in counts${electrons}: those that the place would give in ${this.clock.bins === 1 ? "the exposure" : "one row time"} without the diffuser.`;
  }

  on(listener: (what: Change) => void): void {
    this.listeners.push(listener);
  }

  /** Changes the state; all listeners are told once before the next picture. */
  set(change: Partial<State>, what: Change): void {
    Object.assign(this.state, change);
    this.tell(what);
  }

  tell(what: Change): void {
    if (this.dirty.size === 0) requestAnimationFrame(() => this.flush());
    this.dirty.add(what);
  }

  private flush(): void {
    const dirty = this.dirty;
    this.dirty = new Set();
    for (const what of dirty) for (const listener of this.listeners) listener(what);
  }

  goTo(t: number): void {
    const last = this.clock.bins - 1;
    this.set({ t: Math.min(last, Math.max(0, Math.round(t))) }, "time");
  }
}
