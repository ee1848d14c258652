// Amplitude over frequency of a trace, and the frequency of its peak.

export interface Spectrum {
  /** Hertz, from 0 to half the frame rate. */
  frequency: Float64Array;
  /** Amplitude of a sine of that frequency. */
  amplitude: Float64Array;
  /** Of the largest sine; null where none stands out. */
  peak_hz: number | null;
  /** Whether all values are the same. */
  isConstant: boolean;
}

/** A sine must explain this share of the variance, */
const MIN_EXPLAINED = 0.3;
/** and more than the strongest of n/2 frequencies has in white noise, about 2 ln(n)/n, */
const MIN_EXPLAINED_TIMES_LENGTH = 20;
/** and show two periods within the trace: less is a passage. These are the limits of the report. */
const MIN_PERIODS = 2;
/** Fewest values with a frequency. */
const MIN_BINS = 8;

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
  const variance = centred.reduce((total, v) => total + v * v, 0);
  const isConstant = variance <= 1e-12 * mean * mean * there;
  if (isConstant || best === 0 || there < MIN_BINS) return { frequency, amplitude, peak_hz: null, isConstant };
  const turns = refine(centred, best, points);
  const share = explained(centred, turns) / variance;
  const standsOut = share >= Math.max(MIN_EXPLAINED, MIN_EXPLAINED_TIMES_LENGTH / there) && turns * n >= MIN_PERIODS;
  return { frequency, amplitude, peak_hz: standsOut ? turns * rate_hz : null, isConstant };
}

/** Sum of squares that the least-squares fit a + b cos + c sin takes from values of zero mean. */
function explained(centred: Float64Array, turns: number): number {
  const n = centred.length;
  let [c, s, cc, ss, cs, yc, ys] = [0, 0, 0, 0, 0, 0, 0];
  centred.forEach((y, i) => {
    const [cos, sin] = [Math.cos(2 * Math.PI * turns * i), Math.sin(2 * Math.PI * turns * i)];
    c += cos;
    s += sin;
    cc += cos * cos;
    ss += sin * sin;
    cs += cos * sin;
    yc += y * cos;
    ys += y * sin;
  });
  // The offset is eliminated: products about the means.
  [cc, ss, cs] = [cc - (c * c) / n, ss - (s * s) / n, cs - (c * s) / n];
  const determinant = cc * ss - cs * cs;
  // At half the bins' rate there is no sine, only a cosine.
  if (determinant <= 1e-9 * n * n) return cc > 0 ? (yc * yc) / cc : 0;
  return (yc * yc * ss - 2 * yc * ys * cs + ys * ys * cc) / determinant;
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

/** The sine that explains most between the neighbours of point `best`, by golden section: least squares have no bias
 * from the few periods of a short trace. */
function refine(values: Float64Array, best: number, points: number): number {
  if (best === points - 1) return 0.5;
  const at = (i: number) => (0.5 * i) / (points - 1);
  let [a, b] = [at(best - 1), at(best + 1)];
  const golden = (Math.sqrt(5) - 1) / 2;
  for (let i = 0; i < 30; i++) {
    const [p, q] = [b - golden * (b - a), a + golden * (b - a)];
    if (explained(values, p) > explained(values, q)) b = q;
    else a = p;
  }
  return (a + b) / 2;
}
