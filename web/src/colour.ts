// Colour maps. Sequential ones are even in lightness; time is a hue of OKLCh, as in the report.

import { interpolateCividis, interpolateInferno, interpolateMagma, interpolatePlasma, interpolateViridis } from "d3-scale-chromatic";

export type MapName = "grey" | "viridis" | "magma" | "inferno" | "plasma" | "cividis";

/** The maps as they are offered; all are even in lightness. */
export const MAPS: [MapName, string][] = [
  ["magma", "Magma"],
  ["inferno", "Inferno"],
  ["plasma", "Plasma"],
  ["viridis", "Viridis"],
  ["cividis", "Cividis"],
  ["grey", "Grey"],
];

/** How brightness follows the value between the two limits. */
export interface Scale {
  kind: "linear" | "gamma" | "log";
  /** Exponent of `gamma`: below 1 what is dark becomes brighter. */
  gamma: number;
}

/** Range that a logarithmic scale shows: white over black. */
const LOG_RANGE = 1000;

/** Brightness, 0 to 1, of the part `f` of the way from the lower to the upper limit. */
export function shadeOf(f: number, { kind, gamma }: Scale): number {
  const inside = f <= 0 ? 0 : f >= 1 ? 1 : f;
  if (kind === "gamma") return inside ** gamma;
  if (kind === "log") return Math.max(0, 1 + Math.log(inside) / Math.log(LOG_RANGE));
  return Number.isNaN(inside) ? 0 : inside;
}

export type Rgb = [number, number, number];

/** Colours of regions, those of the report's figures: told apart by people who see red and green alike. */
export const REGION_COLOURS = ["#2a85c9", "#e0662f", "#1a9b74", "#c563ae", "#c2940b", "#7577d6", "#5f8a1f", "#c0504d"];

/** Signed values, blue below zero, red above and black at it, as in the report. */
const SIGNED: readonly Rgb[] = [
  [166, 212, 255],
  [52, 128, 206],
  [18, 18, 22],
  [205, 74, 52],
  [255, 196, 168],
];

function signed(f: number): Rgb {
  const at = Math.min(1, Math.max(0, f)) * (SIGNED.length - 1);
  const i = Math.min(SIGNED.length - 2, Math.floor(at));
  return [0, 1, 2].map((c) => Math.round(SIGNED[i][c] + (at - i) * (SIGNED[i + 1][c] - SIGNED[i][c]))) as Rgb;
}

function parse(text: string): Rgb {
  if (text.startsWith("#")) {
    const n = parseInt(text.slice(1), 16);
    return [n >> 16, (n >> 8) & 255, n & 255];
  }
  const [r, g, b] = text.match(/\d+/g)!.map(Number);
  return [r, g, b];
}

/** The colour at `f`, 0 to 1. */
export function colourOf(map: MapName | "signed", f: number): Rgb {
  switch (map) {
    case "grey": {
      const v = Math.round(255 * f);
      return [v, v, v];
    }
    case "viridis":
      return parse(interpolateViridis(f));
    case "magma":
      return parse(interpolateMagma(f));
    case "inferno":
      return parse(interpolateInferno(f));
    case "plasma":
      return parse(interpolatePlasma(f));
    case "cividis":
      return parse(interpolateCividis(f));
    case "signed":
      return signed(f);
  }
}

const tables = new Map<string, Uint32Array>();

/** 256 colours as the numbers of an ImageData on a little-endian machine. */
export function table(map: MapName | "signed"): Uint32Array {
  let found = tables.get(map);
  if (!found) {
    found = Uint32Array.from({ length: 256 }, (_, i) => pack(colourOf(map, i / 255)));
    tables.set(map, found);
  }
  return found;
}

/** Colours of a finer table, in which `scale` is already taken into account: small values keep their digits. */
export const SHADES = 4096;
const shaded = new Map<string, Uint32Array>();

export function shadedTable(map: MapName, scale: Scale): Uint32Array {
  const key = `${map} ${scale.kind} ${scale.kind === "gamma" ? scale.gamma : ""}`;
  let found = shaded.get(key);
  if (!found) {
    if (shaded.size > 32) shaded.clear();
    const colours = table(map);
    found = Uint32Array.from({ length: SHADES }, (_, i) => colours[Math.round(255 * shadeOf(i / (SHADES - 1), scale))]);
    shaded.set(key, found);
  }
  return found;
}

export function pack([r, g, b]: Rgb): number {
  return ((255 << 24) | (b << 16) | (g << 8) | r) >>> 0;
}

/** Grey with a hint of green: no value. */
export const MISSING = pack([120, 130, 120]);

/** Muted browns, which no colour map has: the hatching of voxels that the frame does not observe. */
export const STRIPES: readonly [Rgb, Rgb] = [
  [84, 78, 66],
  [128, 119, 100],
];

/** Which of the stripes a pixel is on: every fourth diagonal is light. */
export function stripe(y: number, x: number): 0 | 1 {
  return (y + x) % 4 === 0 ? 1 : 0;
}

/** Linear-light RGB of time, `fraction` 0 to 1, from blue over green to red (Ottosson 2020). */
export function timeHue(fraction: number): Rgb {
  const f = Math.min(1, Math.max(0, fraction));
  const hue = ((272 - 250 * f) * Math.PI) / 180;
  const lightness = 0.66 + 0.14 * Math.sin(Math.PI * f);
  let [inside, outside] = [0, 0.19];
  for (let i = 0; i < 12; i++) {
    const middle = 0.5 * (inside + outside);
    const ok = linear(lightness, middle, hue).every((c) => c >= 0 && c <= 1);
    if (ok) inside = middle;
    else outside = middle;
  }
  return linear(lightness, inside, hue);
}

function linear(lightness: number, chroma: number, hue: number): Rgb {
  const a = chroma * Math.cos(hue);
  const b = chroma * Math.sin(hue);
  const l = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3;
  const m = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const s = (lightness - 0.0894841775 * a - 1.291485548 * b) ** 3;
  return [
    4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
    -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
    -0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s,
  ];
}

/** sRGB, 0 to 255, of linear light. */
export function srgb([r, g, b]: Rgb): Rgb {
  const encode = (c: number) => {
    const v = Math.min(1, Math.max(0, c));
    return Math.round(255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055));
  };
  return [encode(r), encode(g), encode(b)];
}
