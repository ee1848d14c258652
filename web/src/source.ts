// Where results come from: the server, or the file that the page stands in.

import type { Meta, Picture } from "./types";
import { Volume } from "./volume";

/** Bytes that are asked for at once. */
const CHUNK = 2 << 20;
/** Requests at once. */
const LANES = 3;

export interface Source {
  readonly isOffline: boolean;
  readonly live: boolean;
  /** A camera that is looked at. */
  readonly isMonitor: boolean;
  readonly results: Meta[];
  /** A video of result `at`; its bins come in the order in which they are wanted. */
  volume(at: number, name: string, wanted: () => number, onLoad: () => void): Volume | null;
  picture(at: number, name: string): Promise<Picture | null>;
  fileUrl(at: number, name: string): string | null;
}

export async function openSource(): Promise<Source> {
  const embedded = document.getElementById("rowburst-data");
  return embedded ? EmbeddedSource.open(embedded.textContent ?? "") : ServerSource.open();
}

class ServerSource implements Source {
  readonly isOffline = false;

  private constructor(
    readonly live: boolean,
    readonly isMonitor: boolean,
    readonly results: Meta[],
  ) {}

  static async open(): Promise<Source> {
    const answer = await fetch("api/view");
    if (answer.status === 409) throw new Error(await answer.text());
    if (!answer.ok) throw new Error(`The server answered ${answer.status}: ${await answer.text()}`);
    const { live, monitor, results } = (await answer.json()) as { live: boolean; monitor?: boolean; results: Meta[] };
    return new ServerSource(live, monitor ?? false, results);
  }

  volume(at: number, name: string, wanted: () => number, onLoad: () => void): Volume | null {
    const { shape, ranges } = this.results[at];
    const range = ranges[name];
    if (!range) return null;
    const volume = new Volume(shape, range, 16);
    const size = Math.max(1, Math.floor(CHUNK / (2 * volume.pixels)));
    const chunks = Math.ceil(volume.bins / size);
    const asked = new Uint8Array(chunks);
    const next = () => {
      // What is seen first, then what will be played, then what was before.
      const first = Math.floor(wanted() / size);
      for (let i = 0; i < chunks; i++) {
        const chunk = (first + i) % chunks;
        if (!asked[chunk]) {
          asked[chunk] = 1;
          return chunk;
        }
      }
      return -1;
    };
    const lane = async () => {
      for (let chunk = next(); chunk >= 0; chunk = next()) {
        const from = chunk * size;
        const to = Math.min(volume.bins, from + size);
        const answer = await fetch(`api/result/${at}/bins/${name}?from=${from}&to=${to}`);
        if (!answer.ok) throw new Error(await answer.text());
        volume.put(from, new Uint16Array(await answer.arrayBuffer()));
        onLoad();
      }
    };
    for (let i = 0; i < LANES; i++) lane().catch(report);
    return volume;
  }

  async picture(at: number, name: string): Promise<Picture | null> {
    if (!this.results[at].images[name]) return null;
    const answer = await fetch(`api/result/${at}/image/${name}`);
    if (!answer.ok) {
      report(new Error(await answer.text()));
      return null;
    }
    const [rows, columns] = (answer.headers.get("x-shape") ?? "").split(" ").map(Number);
    return { rows, columns, data: new Float32Array(await answer.arrayBuffer()) };
  }

  fileUrl(at: number, name: string): string | null {
    return this.results[at].files.includes(name) ? `api/result/${at}/file/${name}` : null;
  }
}

/** A result with its arrays as gzip in base64: 8-bit videos, float32 pictures. */
interface Embedded {
  meta: Meta;
  videos: Record<string, string>;
  pictures: Record<string, string>;
}

class EmbeddedSource implements Source {
  readonly isOffline = true;
  readonly live = false;
  readonly isMonitor = false;
  readonly results: Meta[];

  private constructor(
    private readonly embedded: Embedded,
    private readonly videos: Record<string, Uint8Array>,
  ) {
    this.results = [embedded.meta];
  }

  static async open(text: string): Promise<Source> {
    const embedded = JSON.parse(text) as Embedded;
    const videos: Record<string, Uint8Array> = {};
    for (const [name, packed] of Object.entries(embedded.videos)) videos[name] = await unpack(packed);
    return new EmbeddedSource(embedded, videos);
  }

  volume(_at: number, name: string): Volume | null {
    const { shape, ranges } = this.embedded.meta;
    const data = this.videos[name];
    return data ? new Volume(shape, ranges[name], 8, data) : null;
  }

  async picture(_at: number, name: string): Promise<Picture | null> {
    const packed = this.embedded.pictures[name];
    if (!packed) return null;
    const [rows, columns] = this.embedded.meta.images[name];
    return { rows, columns, data: new Float32Array((await unpack(packed)).buffer) };
  }

  fileUrl(): string | null {
    return null;
  }
}

async function unpack(base64: string): Promise<Uint8Array> {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Shows what went wrong at the top of the page. */
export function report(error: unknown): void {
  const place = document.getElementById("rowburst-error");
  const words = error instanceof Error ? error.message : String(error);
  const lost = error instanceof TypeError ? "The server does not answer: was rowburst ended? " : "";
  if (place) {
    place.textContent = lost + words;
    place.hidden = false;
  }
}
