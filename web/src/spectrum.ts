// Amplitude over frequency of a trace, and the frequency of its peak.

export interface Spectrum {
  /** Hertz, from 0 to half the frame rate. */
  frequency: Float64Array;
  /** Amplitude of a sine of that frequency. */
  amplitude: Float64Array;
  /** Of the largest sine; null where nothing changes. */
  peak_hz: number | null;
}

/** Points for each 1/duration, so that the peak is not missed. */
const OVERSAMPLED = 8;

/** The Fourier sum of `values` without their mean, at a cost of 4·n² for n bins. */
export function spectrum(values: Float64Array, rate_hz: number): Spectrum {
  const n = values.length;
  let [sum, there] = [0, 0];
  for (const v of values) {
    if (Number.isFinite(v)) {
      sum += v;
      there++;
    }
  }
  const mean = there ? sum / there : 0;
  const centred = Float64Array.from(values, (v) => (Number.isFinite(v) ? v - mean : 0));
  const points = Math.max(2, Math.floor((OVERSAMPLED * n) / 2) + 1);
  const frequency = new Float64Array(points);
  const amplitude = new Float64Array(points);
  let best = 0;
  for (let i = 0; i < points; i++) {
    const turns = (0.5 * i) / (points - 1);
    frequency[i] = turns * rate_hz;
    amplitude[i] = level(centred, turns, there);
    if (turns * n >= 0.75 && amplitude[i] > amplitude[best]) best = i;
  }
  const spread = Math.max(...centred.map(Math.abs));
  if (best === 0 || spread === 0 || amplitude[best] < 1e-9 * spread) return { frequency, amplitude, peak_hz: null };
  return { frequency, amplitude, peak_hz: refine(centred, best, points, there) * rate_hz };
}

/** Amplitude at `turns` per bin. At half the bins' rate amplitude and phase cannot be told apart: there
 * it is that of the largest sine that looks the same. */
function level(values: Float64Array, turns: number, there: number): number {
  const [cos, sin] = [Math.cos(2 * Math.PI * turns), Math.sin(2 * Math.PI * turns)];
  let [c, s, re, im] = [1, 0, 0, 0];
  for (const v of values) {
    re += v * c;
    im += v * s;
    [c, s] = [c * cos - s * sin, s * cos + c * sin];
  }
  return (2 * Math.hypot(re, im)) / Math.max(1, there);
}

/** The peak between the neighbours of point `best`, by golden section. */
function refine(values: Float64Array, best: number, points: number, there: number): number {
  if (best === points - 1) return 0.5;
  const at = (i: number) => (0.5 * i) / (points - 1);
  let [a, b] = [at(best - 1), at(best + 1)];
  const golden = (Math.sqrt(5) - 1) / 2;
  for (let i = 0; i < 30; i++) {
    const [p, q] = [b - golden * (b - a), a + golden * (b - a)];
    if (level(values, p, there) > level(values, q, there)) b = q;
    else a = p;
  }
  return (a + b) / 2;
}
