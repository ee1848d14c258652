// MP4 of the clip: the browser's own encoder (WebCodecs), put into a file by mediabunny.

import { BufferTarget, EncodedPacket, EncodedVideoPacketSource, Mp4OutputFormat, Output } from "mediabunny";
import type { Clip } from "./clip";
import { pack } from "./colour";

/** Bits for each pixel of each picture: sharp edges of enlarged pixels need more than a film does. */
const BITS_PER_PIXEL = 0.5;
const [LEAST_BITRATE, MOST_BITRATE] = [4e6, 60e6];
/** Seconds from one key picture to the next, so that seeking is quick. */
const KEY_S = 1;
/** Pictures that may wait for the encoder. */
const QUEUE = 8;

type Kind = "avc" | "vp9" | "av1";

/** Codecs, the most widely played first. H.264's level follows from its blocks of 16×16. */
function candidates(width: number, height: number): [Kind, string][] {
  const blocks = Math.ceil(width / 16) * Math.ceil(height / 16);
  const level = blocks <= 3600 ? "1f" : blocks <= 8192 ? "28" : "33";
  const avc: [Kind, string][] = [["avc", `avc1.6400${level}`], ["avc", `avc1.42e0${level}`]];
  return [...(blocks <= 36_864 ? avc : []), ["vp9", "vp09.00.51.08"], ["av1", "av01.0.13M.08"]];
}

/** The first codec that this browser encodes; null where there is none. */
async function encodable(width: number, height: number, fps: number): Promise<[Kind, VideoEncoderConfig] | null> {
  if (typeof VideoEncoder === "undefined") return null;
  const bitrate = Math.min(MOST_BITRATE, Math.max(LEAST_BITRATE, BITS_PER_PIXEL * width * height * fps));
  for (const [kind, codec] of candidates(width, height)) {
    const config: VideoEncoderConfig = { codec, width, height, bitrate, framerate: fps, latencyMode: "quality" };
    if (kind === "avc") config.avc = { format: "avc" };
    const answer = await VideoEncoder.isConfigSupported(config).catch(() => null);
    if (answer?.supported) return [kind, config];
  }
  return null;
}

/** The clip at `fps` bins a second; null where this browser has no encoder. */
export async function mp4(clip: Clip, fps: number, progress: (done: number) => void): Promise<Blob | null> {
  // Encoders ask for even sides.
  const [width, height] = [clip.width + (clip.width & 1), clip.height + (clip.height & 1)];
  const found = await encodable(width, height, fps);
  if (!found) return null;
  const [kind, config] = found;
  const target = new BufferTarget();
  const output = new Output({ format: new Mp4OutputFormat({ fastStart: "in-memory" }), target });
  const track = new EncodedVideoPacketSource(kind);
  output.addVideoTrack(track, { frameRate: fps });
  await output.start();

  let failed: unknown = null;
  let written: Promise<void> = Promise.resolve();
  const encoder = new VideoEncoder({
    output: (chunk, meta) => {
      written = written.then(() => track.add(EncodedPacket.fromEncodedChunk(chunk), meta));
    },
    error: (error) => (failed = error),
  });
  encoder.configure(config);
  const canvas = new OffscreenCanvas(width, height);
  const ctx = canvas.getContext("2d", { willReadFrequently: true })!;
  const image = new ImageData(width, height);
  const pixels = new Uint32Array(image.data.buffer);
  const colours = Uint32Array.from(clip.palette, pack);
  const every = Math.max(1, Math.round(fps * KEY_S));
  const step = 1e6 / fps;
  for (let t = 0; t < clip.bins && !failed; t++) {
    const index = clip.at(t);
    for (let y = 0; y < height; y++) {
      const row = Math.min(y, clip.height - 1) * clip.width;
      for (let x = 0; x < width; x++) pixels[y * width + x] = colours[index[row + Math.min(x, clip.width - 1)]];
    }
    ctx.putImageData(image, 0, 0);
    const picture = new VideoFrame(canvas, { timestamp: Math.round(t * step), duration: Math.round(step) });
    encoder.encode(picture, { keyFrame: t % every === 0 });
    picture.close();
    progress(t + 1);
    do {
      await new Promise((resolve) => setTimeout(resolve, 0));
    } while (encoder.encodeQueueSize > QUEUE && !failed);
  }
  if (!failed) await encoder.flush().catch((error: unknown) => (failed ??= error));
  if (encoder.state !== "closed") encoder.close();
  if (failed) throw failed;
  await written;
  await output.finalize();
  return new Blob([target.buffer!], { type: "video/mp4" });
}
