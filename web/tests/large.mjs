// Writes a result of so many bins, rows and columns: a spot that goes round.
//     large.mjs FOLDER BINS ROWS COLUMNS

import { existsSync } from "node:fs";
import { open, writeFile } from "node:fs/promises";
import { join } from "node:path";

const folder = process.argv[2];
const [bins, rows, columns] = process.argv.slice(3).map(Number);
const path = join(folder, "video.npy");
if (!existsSync(join(folder, "result.json"))) {
  const header = `{'descr': '<f4', 'fortran_order': False, 'shape': (${bins}, ${rows}, ${columns}), }`;
  const length = 128;
  const start = Buffer.alloc(length, " ");
  start.write("\x93NUMPY\x01\x00", 0, "latin1");
  start.writeUInt16LE(length - 10, 8);
  start.write(header, 10, "latin1");
  start.write("\n", length - 1);
  const file = await open(path, "w");
  await file.write(start);
  const bin = new Float32Array(rows * columns);
  for (let t = 0; t < bins; t++) {
    const [cy, cx] = [rows / 2 + 0.3 * rows * Math.sin(t / 20), columns / 2 + 0.3 * columns * Math.cos(t / 20)];
    for (let y = 0; y < rows; y++) {
      for (let x = 0; x < columns; x++) bin[y * columns + x] = Math.exp(-((y - cy) ** 2 + (x - cx) ** 2) / 4000);
    }
    await file.write(Buffer.from(bin.buffer));
  }
  await file.close();
  await writeFile(join(folder, "view.json"), JSON.stringify({ ranges: { video: [0, 1] } }));
  await writeFile(join(folder, "result.json"), JSON.stringify({ frame_rate_hz: 100000 }));
}
