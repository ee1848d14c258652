// Writes a result of 256 bins of 512×512 pixels: a spot that goes round.

import { existsSync } from "node:fs";
import { open, writeFile } from "node:fs/promises";
import { join } from "node:path";

const [bins, rows, columns] = [256, 512, 512];
const folder = process.argv[2];
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
    const [cy, cx] = [256 + 150 * Math.sin(t / 20), 256 + 150 * Math.cos(t / 20)];
    for (let y = 0; y < rows; y++) {
      for (let x = 0; x < columns; x++) bin[y * columns + x] = Math.exp(-((y - cy) ** 2 + (x - cx) ** 2) / 4000);
    }
    await file.write(Buffer.from(bin.buffer));
  }
  await file.close();
  await writeFile(join(folder, "view.json"), JSON.stringify({ ranges: { video: [0, 1] } }));
  await writeFile(join(folder, "result.json"), JSON.stringify({ frame_rate_hz: 100000 }));
}
