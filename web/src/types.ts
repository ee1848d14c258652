// What the server (or the offline file) says of a result.

export interface Rect {
  y: number;
  x: number;
  rows: number;
  columns: number;
}

export interface Photodiode {
  name: string;
  correlation: number;
  /** Microseconds and light, on the clock and in the units of the trace. */
  points: [number, number][];
}

/** A trace that the program has found, with its standard errors. */
export interface KnownTrace {
  region: Rect;
  /** Number and colour in the figures of the report; absent in results of earlier versions. */
  number?: number;
  colour?: string;
  /** Whether the user asked for it, with `--region`. */
  requested?: boolean;
  value: number[];
  debiased: (number | null)[];
  standard_error: (number | null)[];
  frequency_hz: number | null;
  frequency_error_hz: number | null;
  photodiodes: Photodiode[];
}

export interface HistoryPoint {
  iteration: number;
  seconds: number;
  residual_over_sigma: number;
  psnr_db: number | null;
}

/** view.json. */
export interface View {
  /** The title of the report. */
  title?: string;
  pixel_pitch_um?: number | null;
  /** Start of the first bin, from the start of exposure of the row that is read first; absent in results of 0.1. */
  start_us?: number | null;
  /** From the trigger to the zero of time. */
  trigger_delay_us?: number | null;
  /** Size of an image on the sensor over that of the object. */
  magnification?: number | null;
  gain_electrons_per_count?: number | null;
  /** The unit of the values; absent in results of earlier versions. */
  unit?: string;
  row_bins?: [number, number][];
  traces?: KnownTrace[];
  course?: HistoryPoint[];
  headline?: [string, string][];
  settings?: [string, [string, string][]][];
  fit?: { verdict: string; reason: string };
  warnings?: string[];
  command?: string;
  /** Part of the voxels that the frame observes; absent where it observes all. */
  coverage_fraction?: number | null;
}

export interface Meta {
  name: string;
  /** Bins, rows and columns. */
  shape: [number, number, number];
  /** Value of the lowest and the highest number of each video. */
  ranges: Record<string, [number, number]>;
  /** Rows and columns of each picture. */
  images: Record<string, [number, number]>;
  files: string[];
  bin_duration_us: number | null;
  view: View | null;
  result: Record<string, unknown> | null;
}

/** A picture [y, x] of real values. */
export interface Picture {
  rows: number;
  columns: number;
  data: Float32Array;
}

/** The state of a run, as /api/live has it. */
export interface LiveState {
  stage: "running" | "stopping" | "writing" | "done" | "failed";
  label: string;
  iteration: number | null;
  max_iterations: number | null;
  seconds: number | null;
  /** Iteration, seconds, residual over σ, PSNR. */
  course: [number, number, number, number | null][];
  snapshot: number;
  error: string | null;
}

/** A number of a camera that can be set. */
export interface CameraControl {
  name: string;
  value: number;
  min: number;
  max: number;
  unit: string | null;
}

/** A camera that is looked at, as /api/monitor has it. */
export interface MonitorState {
  reconstructs: boolean;
  frame_snapshot: number;
  video_snapshot: number;
  frames?: number;
  frames_per_second?: number;
  dropped?: number;
  incomplete?: number;
  /** Frames that came while the solver was busy. */
  skipped?: number;
  /** Frames of the recording that goes on. */
  recording?: number | null;
  exposure?: {
    number: number;
    histogram: number[];
    saturation_counts: number;
    saturated_fraction: number;
    mean: number;
    max: number;
    contrast: number | null;
    grain_px: number | null;
  };
  video?: {
    number: number;
    latency_ms: number;
    solver_ms: number;
    videos_per_second: number | null;
    iterations: number;
    residual_over_sigma: number;
    warm_start: boolean;
    fit: string;
  };
  /** What the camera lets be set while frames come. */
  controls?: CameraControl[];
  warnings?: string[];
  message?: string;
  ended?: string;
  error?: string | null;
}
