// Axes of pictures that are drawn on a canvas: ticks at round values, numbers, a name with its unit.

import { number } from "./format";

/** Round values from `low` to `high`, about `count` of them. */
export function ticks(low: number, high: number, count: number): number[] {
  const span = high - low;
  if (!(span > 0) || !Number.isFinite(span)) return [low];
  const rough = span / Math.max(1, count);
  const decade = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((f) => f * decade).find((s) => s >= rough * 0.999)!;
  const first = Math.ceil(low / step - 1e-9);
  const last = Math.floor(high / step + 1e-9);
  return Array.from({ length: Math.max(0, last - first) + 1 }, (_, i) => Number(((first + i) * step).toPrecision(12)));
}

export interface Axis {
  low: number;
  high: number;
  label: string;
}

/** A place on a canvas, in CSS pixels. */
export interface Place {
  x: number;
  y: number;
  width: number;
  height: number;
}

export interface Ink {
  text: string;
  line: string;
}

/** Ticks, numbers and names left of `place` and below it; the upright axis has `low` at the top. */
export function drawAxes(ctx: CanvasRenderingContext2D, place: Place, across: Axis, down: Axis, ink: Ink): void {
  ctx.save();
  ctx.font = "11px system-ui, sans-serif";
  ctx.strokeStyle = ink.line;
  ctx.fillStyle = ink.text;
  ctx.lineWidth = 1;
  const stroke = (x0: number, y0: number, x1: number, y1: number) => {
    ctx.beginPath();
    ctx.moveTo(x0, y0);
    ctx.lineTo(x1, y1);
    ctx.stroke();
  };
  const { x, y, width, height } = place;
  ctx.textAlign = "center";
  ctx.textBaseline = "top";
  for (const value of ticks(across.low, across.high, Math.max(2, Math.floor(width / 80)))) {
    const at = x + ((value - across.low) / (across.high - across.low)) * width;
    stroke(at, y + height, at, y + height + 4);
    ctx.fillText(number(value, 4), at, y + height + 6);
  }
  ctx.fillText(across.label, x + width / 2, y + height + 20);
  ctx.textAlign = "right";
  ctx.textBaseline = "middle";
  for (const value of ticks(down.low, down.high, Math.max(2, Math.floor(height / 40)))) {
    const at = y + ((value - down.low) / (down.high - down.low)) * height;
    stroke(x - 4, at, x, at);
    ctx.fillText(number(value, 4), x - 6, at);
  }
  ctx.translate(x - 42, y + height / 2);
  ctx.rotate(-Math.PI / 2);
  ctx.textAlign = "center";
  ctx.fillText(down.label, 0, 0);
  ctx.restore();
}
