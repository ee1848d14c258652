// Numbers in words.

/** Enough digits to tell values apart, not more. */
export function number(value: number, digits = 4): string {
  if (!Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e6 || size < 1e-3) return value.toExponential(Math.max(0, digits - 2)).replace("e+", "e");
  return String(Number(value.toPrecision(digits)));
}

/** A whole number with thin groups of three digits. */
export function grouped(value: number): string {
  return Math.round(value).toLocaleString("en-GB");
}

/** A part of a whole. */
export function percent(fraction: number): string {
  if (fraction > 0 && fraction < 0.001) return "below 0.1 %";
  return `${(100 * fraction).toFixed(1)} %`;
}

/** A frequency with its unit. */
export function hertz(value: number, error?: number | null): string {
  const [unit, scale] = value >= 1e6 ? ["MHz", 1e6] : value >= 1e3 ? ["kHz", 1e3] : ["Hz", 1];
  const text = (v: number, digits: number) => (v / scale).toFixed(digits);
  if (error != null && Number.isFinite(error) && error > 0) {
    const digits = Math.min(6, Math.max(0, Math.ceil(-Math.log10(error / scale)) + 1));
    return `${text(value, digits)} ± ${text(error, digits)} ${unit}`;
  }
  return `${text(value, 2)} ${unit}`;
}

/**
 * The time axis of a video: microseconds where the duration of a bin is known, else bins. Zero is the start of exposure of
 * the row that is read first.
 */
export class Clock {
  /** Start and end of the video. */
  readonly start: number;
  readonly end: number;

  constructor(
    readonly bins: number,
    readonly step_us: number | null,
    start_us: number | null = null,
  ) {
    this.start = step_us == null ? 0 : (start_us ?? 0);
    this.end = this.start + bins * (step_us ?? 1);
  }

  get unit(): string {
    return this.step_us == null ? "bins" : "µs";
  }

  /** Middle of bin `t`. */
  at(t: number): number {
    return this.start + (t + 0.5) * (this.step_us ?? 1);
  }

  /** The bin that holds `time`. */
  bin(time: number): number {
    return Math.min(this.bins - 1, Math.max(0, Math.floor((time - this.start) / (this.step_us ?? 1))));
  }

  label(t: number): string {
    if (this.step_us == null) return `bin ${t}`;
    const digits = this.step_us < 0.1 ? 3 : this.step_us < 1 ? 2 : 1;
    return `${this.at(t).toFixed(digits)} µs`;
  }
}
