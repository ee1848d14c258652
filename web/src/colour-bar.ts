// The colour bar of a saved picture: the map with its scale, values and unit.

import { ticks, type Ink, type Place } from "./axis";
import { colourOf, shadeOf, type MapName, type Scale } from "./colour";
import { number } from "./format";

/** Room that a bar with its numbers takes, in CSS pixels. */
export const BAR_WIDTH = 96;
const WIDE = 12;
const HEAD = 20;

export interface Bar {
  map: MapName | "signed";
  scale: Scale;
  low: number;
  high: number;
  unit: string;
}

/** Values that stand beside the bar, and the power of ten that they share. */
export function barTicks({ low, high, scale }: Bar, count: number): { values: number[]; exponent: number } {
  const size = Math.max(Math.abs(low), Math.abs(high));
  const exponent = size > 0 && (size >= 1e4 || size < 1e-2) ? Math.floor(Math.log10(size)) : 0;
  if (scale.kind !== "log") return { values: ticks(low, high, count), exponent };
  const values = [0, 1, 2, 3].map((decades) => low + (high - low) / 10 ** decades);
  return { values, exponent };
}

/** Draws the bar with its unit above and its numbers at the right. */
export function drawColourBar(ctx: CanvasRenderingContext2D, { x, y, height }: Place, bar: Bar, ink: Ink): void {
  const tall = Math.max(24, height - HEAD - 6);
  const top = y + HEAD;
  for (let i = 0; i < tall; i++) {
    const [r, g, b] = colourOf(bar.map, 1 - (i + 0.5) / tall);
    ctx.fillStyle = `rgb(${r} ${g} ${b})`;
    ctx.fillRect(x, top + i, WIDE, 1.5);
  }
  ctx.strokeStyle = ink.line;
  ctx.lineWidth = 1;
  ctx.strokeRect(x, top, WIDE, tall);
  const { values, exponent } = barTicks(bar, Math.max(2, Math.floor(tall / 36)));
  const scale: Scale = bar.map === "signed" ? { kind: "linear", gamma: 1 } : bar.scale;
  ctx.fillStyle = ink.text;
  ctx.font = "11px system-ui, sans-serif";
  ctx.textAlign = "left";
  ctx.textBaseline = "middle";
  for (const value of values) {
    const at = top + tall * (1 - shadeOf((value - bar.low) / (bar.high - bar.low || 1), scale));
    ctx.fillRect(x + WIDE, at - 0.5, 4, 1);
    ctx.fillText(number(value / 10 ** exponent, 3), x + WIDE + 7, at);
  }
  ctx.textBaseline = "alphabetic";
  ctx.fillText(exponent ? `×10${raised(exponent)} ${bar.unit}` : bar.unit, x, y + 12);
}

function raised(n: number): string {
  return String(n).replace(/[-\d]/g, (c) => (c === "-" ? "⁻" : "⁰¹²³⁴⁵⁶⁷⁸⁹"[Number(c)]));
}
