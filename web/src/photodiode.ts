// A photodiode's signal laid over a trace, as crates/rowburst/src/traces/photodiode.rs does it: the
// time shift is that of the highest correlation, gain and offset are those of least squares.

import type { Clock } from "./format";

export interface Signal {
  name: string;
  times_us: Float64Array;
  values: Float64Array;
  /** Integral from the first point to each. */
  integrals: Float64Array;
}

export interface Alignment {
  /** The trace that it fits best. */
  trace: number;
  correlation: number;
  /** To be added to the signal's times. */
  shift_us: number;
  gain: number;
  offset: number;
}

interface Fit {
  correlation: number;
  gain: number;
  offset: number;
}

/** Microseconds in the unit of the time column. */
const TIMES: Record<string, number> = { time_us: 1, time_ns: 1e-3, time_ms: 1e3, time_s: 1e6 };
const MAX_BYTES = 64 << 20;
/** Values compared with the traces: more would take seconds. */
const MAX_OPERATIONS = 3e7;
const MIN_OVERLAP = 0.5;
const STEPS_PER_BIN = 16;
/** Correlations that are closer than this part of 1 − r are alike; the smallest shift is meant. */
const TIE_FRACTION = 0.5;
const [MIN_TIE, MAX_TIE] = [0.002, 0.02];

/** Reads `time_us,value` (or time_s, time_ms, time_ns) with a line for each sample. */
export async function readSignal(file: File): Promise<Signal> {
  if (file.size > MAX_BYTES) throw new Error(`${file.name} has ${file.size >> 20} MB; the page reads up to ${MAX_BYTES >> 20} MB. Cut it to the time of the frame.`);
  const lines = (await file.text())
    .split(/\r?\n/)
    .map((text, i) => ({ text: text.trim(), number: i + 1 }))
    .filter(({ text }) => text && !text.startsWith("#"));
  const cells = (text: string) => text.split(/[,;\t]/).map((c) => c.trim().replace(/^"|"$/g, ""));
  const names = cells(lines[0]?.text.toLowerCase() ?? "");
  const us = TIMES[names[0]];
  if (us === undefined || names.length !== 2) {
    throw new Error(`${file.name}: the first line is "${lines[0]?.text ?? ""}"; it has to name the columns, such as time_us,value (or time_s, time_ms, time_ns).`);
  }
  const samples = lines.slice(1);
  if (samples.length < 2) throw new Error(`${file.name} has ${samples.length} samples; a signal has at least two.`);
  const [times_us, values] = [new Float64Array(samples.length), new Float64Array(samples.length)];
  const integrals = new Float64Array(samples.length);
  samples.forEach(({ text, number }, i) => {
    const parts = cells(text);
    const [time, value] = parts.map((p) => (p === "" ? NaN : Number(p)));
    const later = i === 0 || time * us > times_us[i - 1];
    if (parts.length !== 2 || !Number.isFinite(time) || !Number.isFinite(value) || !later) {
      throw new Error(`${file.name}, line ${number}: "${text}"; a line has two numbers, the time (later than the one before) and the value.`);
    }
    [times_us[i], values[i]] = [time * us, value];
    if (i > 0) integrals[i] = integrals[i - 1] + 0.5 * (values[i] + values[i - 1]) * (times_us[i] - times_us[i - 1]);
  });
  return { name: file.name, times_us, values, integrals };
}

function integral({ times_us, values, integrals }: Signal, time: number): number {
  let [low, high] = [0, times_us.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times_us[middle] <= time) low = middle + 1;
    else high = middle;
  }
  const i = Math.min(times_us.length - 1, Math.max(1, low)) - 1;
  const span = times_us[i + 1] - times_us[i];
  const part = (time - times_us[i]) / span;
  return integrals[i] + (values[i] + 0.5 * part * (values[i + 1] - values[i])) * part * span;
}

/** Mean over each bin; NaN where the signal does not cover it. */
function binned(signal: Signal, { bins, start }: Clock, step: number, shift: number): Float64Array {
  const { times_us } = signal;
  const [first, last] = [times_us[0], times_us[times_us.length - 1]];
  // A sample stands for the time about it.
  const slack = (0.5 * (last - first)) / (times_us.length - 1) + 1e-6 * step;
  return Float64Array.from({ length: bins }, (_, t) => {
    const [from, to] = [start + t * step - shift, start + (t + 1) * step - shift];
    if (from < first - slack || to > last + slack) return NaN;
    const [a, b] = [Math.max(from, first), Math.min(to, last)];
    return b > a ? (integral(signal, b) - integral(signal, a)) / (b - a) : NaN;
  });
}

function fitOf(signal: Float64Array, trace: Float64Array): Fit | null {
  let [n, x, y] = [0, 0, 0];
  for (let t = 0; t < signal.length; t++) {
    if (Number.isNaN(signal[t]) || Number.isNaN(trace[t])) continue;
    n++;
    x += signal[t];
    y += trace[t];
  }
  if (n < 3 || n < MIN_OVERLAP * trace.length) return null;
  [x, y] = [x / n, y / n];
  let [xx, yy, xy] = [0, 0, 0];
  for (let t = 0; t < signal.length; t++) {
    if (Number.isNaN(signal[t]) || Number.isNaN(trace[t])) continue;
    xx += (signal[t] - x) ** 2;
    yy += (trace[t] - y) ** 2;
    xy += (signal[t] - x) * (trace[t] - y);
  }
  const flat = (sum: number, mean: number) => sum <= 1e-18 * n * mean * mean || sum <= 0;
  if (flat(xx, x) || flat(yy, y)) return null;
  const gain = xy / xx;
  return { correlation: xy / Math.sqrt(xx * yy), gain, offset: y - gain * x };
}

/** Lays the signal over the trace that it fits best; null where it fits none. */
export function align(signal: Signal, traces: Float64Array[], clock: Clock): Alignment | null {
  const { bins, step_us: step } = clock;
  if (step == null || traces.length === 0) return null;
  const [first, last] = [signal.times_us[0], signal.times_us[signal.times_us.length - 1]];
  const length = step * bins;
  const overlap = MIN_OVERLAP * Math.min(length, last - first);
  const [low, high] = [clock.start + overlap - last, clock.start + length - overlap - first];
  const count = Math.max(0, Math.ceil(((high - low) * STEPS_PER_BIN) / step)) + 1;
  if (count * bins > MAX_OPERATIONS) {
    throw new Error(`${signal.name} is ${Math.round((last - first) / length)} times as long as the video; cut it to the time of the frame, or give it to rowburst reconstruct with --photodiode.`);
  }
  // Shift 0 is among them.
  const fine = step / STEPS_PER_BIN;
  const start = Math.ceil(low / fine) * fine;
  const fits: (Fit | null)[][] = traces.map(() => []);
  for (let k = 0; k < count; k++) {
    const mean = binned(signal, clock, step, start + k * fine);
    traces.forEach((trace, i) => fits[i].push(fitOf(mean, trace)));
  }
  const correlation = (i: number, k: number) => fits[i][k]?.correlation ?? -Infinity;
  let [trace, best] = [0, -Infinity];
  fits.forEach((all, i) => {
    for (let k = 0; k < all.length; k++) if (correlation(i, k) > best) [trace, best] = [i, correlation(i, k)];
  });
  if (best === -Infinity) return null;
  const enough = best - Math.min(MAX_TIE, Math.max(MIN_TIE, TIE_FRACTION * (1 - best)));
  // A maximum as good as the best, and nearest to no shift at all.
  let peak = -1;
  const shiftOf = (k: number) => start + k * fine;
  for (let k = 0; k < count; k++) {
    const here = correlation(trace, k);
    const isPeak = here >= enough && (k === 0 || correlation(trace, k - 1) <= here) && (k + 1 === count || correlation(trace, k + 1) <= here);
    if (isPeak && (peak < 0 || Math.abs(shiftOf(k)) < Math.abs(shiftOf(peak)))) peak = k;
  }
  const at = (shift: number) => fitOf(binned(signal, clock, step, shift), traces[trace]);
  const shift_us = refined((shift) => at(shift)?.correlation ?? -Infinity, shiftOf(peak), fine);
  const fit = at(shift_us);
  return fit && { trace, shift_us, ...fit };
}

/** The highest value within `reach` of `about`. */
function refined(value: (shift: number) => number, about: number, reach: number): number {
  let [low, high] = [about - reach, about + reach];
  for (let i = 0; i < 30; i++) {
    const third = (high - low) / 3;
    if (value(low + third) < value(high - third)) low += third;
    else high -= third;
  }
  const middle = 0.5 * (low + high);
  return value(middle) > value(about) ? middle : about;
}

/** Most points of a curve; a screen shows no more. */
const MAX_POINTS = 5000;

/** The signal's points within the video, on its clock and in the units of the trace. */
export function alignedPoints(signal: Signal, { shift_us, gain, offset }: Alignment, clock: Clock): [number[], number[]] {
  const [x, y]: [number[], number[]] = [[], []];
  for (let i = 0; i < signal.values.length; i++) {
    const time = signal.times_us[i] + shift_us;
    if (time < clock.start || time > clock.end) continue;
    x.push(time);
    y.push(gain * signal.values[i] + offset);
  }
  const every = Math.max(1, Math.ceil(x.length / MAX_POINTS));
  const kept = (_: number, i: number) => i % every === 0;
  return [x.filter(kept), y.filter(kept)];
}
