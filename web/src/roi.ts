// Regions and lines as ImageJ keeps them: `.roi`, and several of them in a `.zip` (ij.io.RoiDecoder and RoiEncoder).

import { strToU8, unzipSync, zipSync } from "fflate";
import type { Rect } from "./types";

/** A rectangle or a straight line with its name. */
export interface Roi {
  name: string;
  rect: Rect | null;
  line: { x0: number; y0: number; x1: number; y1: number } | null;
  /** Whether it has another form, of which `rect` is the bounding box. */
  isBox: boolean;
}

const [HEADER, HEADER2] = [64, 64];
const VERSION = 228;
const [RECT, LINE, POINT] = [1, 3, 10];
/** Files of more bytes, or with more regions, are no set of regions that a person has drawn. */
const MAX_BYTES = 4 << 20;
const MAX_ROIS = 1000;

/** The bytes of one `.roi`. */
export function encodeRoi({ name, rect, line }: Roi): Uint8Array {
  const bytes = new Uint8Array(HEADER + HEADER2 + 2 * name.length);
  const view = new DataView(bytes.buffer);
  bytes.set(strToU8("Iout"));
  view.setInt16(4, VERSION);
  bytes[6] = line ? LINE : RECT;
  const box = line
    ? [Math.min(line.y0, line.y1), Math.min(line.x0, line.x1), Math.max(line.y0, line.y1), Math.max(line.x0, line.x1)]
    : [rect!.y, rect!.x, rect!.y + rect!.rows, rect!.x + rect!.columns];
  box.forEach((v, i) => view.setInt16(8 + 2 * i, Math.round(v)));
  if (line) [line.x0, line.y0, line.x1, line.y1].forEach((v, i) => view.setFloat32(18 + 4 * i, v));
  view.setInt32(60, HEADER);
  view.setInt32(HEADER + 16, HEADER + HEADER2);
  view.setInt32(HEADER + 20, name.length);
  for (let i = 0; i < name.length; i++) view.setUint16(HEADER + HEADER2 + 2 * i, name.charCodeAt(i));
  return bytes;
}

/** The region in the bytes of a `.roi`; `file` names it in errors and where it has no name of its own. */
export function decodeRoi(bytes: Uint8Array, file: string): Roi {
  if (bytes.length < HEADER || String.fromCharCode(...bytes.subarray(0, 4)) !== "Iout") {
    throw new Error(`${file} is no ImageJ region: it does not begin with "Iout". Save regions in ImageJ's ROI Manager with More, Save.`);
  }
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const type = bytes[6];
  const name = nameOf(view) ?? file.replace(/^.*\//, "").replace(/\.roi$/i, "");
  if (type === LINE) {
    const [x0, y0, x1, y1] = [18, 22, 26, 30].map((at) => view.getFloat32(at));
    if (![x0, y0, x1, y1].every(Number.isFinite)) throw new Error(`${file}: the ends of the line are no numbers.`);
    return { name, rect: null, line: { x0, y0, x1, y1 }, isBox: false };
  }
  const [top, left, bottom, right] = [8, 10, 12, 14].map((at) => view.getInt16(at));
  const grow = type === POINT ? 1 : 0;
  const rect = { y: top, x: left, rows: Math.max(grow, bottom - top), columns: Math.max(grow, right - left) };
  if (rect.rows < 1 || rect.columns < 1) throw new Error(`${file}: the region has no pixels.`);
  return { name, rect, line: null, isBox: type !== RECT && type !== POINT };
}

function nameOf(view: DataView): string | null {
  const second = view.getInt32(60);
  if (second < HEADER || second + 24 > view.byteLength) return null;
  const [at, length] = [view.getInt32(second + 16), view.getInt32(second + 20)];
  if (at <= 0 || length <= 0 || at + 2 * length > view.byteLength) return null;
  return Array.from({ length }, (_, i) => String.fromCharCode(view.getUint16(at + 2 * i))).join("");
}

/** A `.zip` as the ROI Manager writes it: a `.roi` for each region, whose name is that of its file. */
export function encodeRois(rois: Roi[]): Uint8Array {
  const files: Record<string, Uint8Array> = {};
  for (const roi of rois) {
    const plain = roi.name.replace(/[\\/:*?"<>|]/g, "_") || "region";
    let name = `${plain}.roi`;
    for (let n = 2; name in files; n++) name = `${plain}-${n}.roi`;
    files[name] = encodeRoi(roi);
  }
  return zipSync(files);
}

/** All regions of a `.roi` or a `.zip`. */
export function decodeRois(bytes: Uint8Array, file: string): Roi[] {
  if (bytes.length > MAX_BYTES) throw new Error(`${file} has ${bytes.length >> 20} MB; a set of regions has at most ${MAX_BYTES >> 20} MB.`);
  if (bytes[0] !== 0x50 || bytes[1] !== 0x4b) return [decodeRoi(bytes, file)];
  let unpacked = 0;
  const files = unzipSync(bytes, {
    filter: ({ name, originalSize }) => {
      unpacked += originalSize;
      if (unpacked > MAX_BYTES) throw new Error(`${file} unpacks to more than ${MAX_BYTES >> 20} MB.`);
      return /\.roi$/i.test(name);
    },
  });
  const names = Object.keys(files);
  if (names.length === 0) throw new Error(`${file} holds no .roi.`);
  if (names.length > MAX_ROIS) throw new Error(`${file} holds ${names.length} regions; at most ${MAX_ROIS} are read.`);
  return names.map((name) => decodeRoi(files[name], name));
}
