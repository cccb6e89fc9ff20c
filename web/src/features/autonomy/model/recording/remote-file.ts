/** Reads parts of a stored file, so that one row of a minute is shown before the minute is downloaded. */
import type { storedPart } from "../../../../shared/api/recordings";

/** Bytes of a file. */
export interface FileParts {
  /** [bytes] */
  length: number;
  read: (from: number, to: number) => Promise<Uint8Array>;
}

/** A file in memory. */
export function memoryFile(content: Uint8Array): FileParts {
  return { length: content.length, read: (from, to) => Promise.resolve(content.subarray(from, to)) };
}

/** A file of a store. If the store sends the whole file instead of a part, it is kept. */
export class RemoteFile implements FileParts {
  readonly length: number;
  readonly #part: (from: number, to: number) => ReturnType<typeof storedPart>;
  #content: Uint8Array<ArrayBuffer> | null = null;

  /** `length` [bytes]. `part`: downloads a part. */
  constructor(length: number, part: (from: number, to: number) => ReturnType<typeof storedPart>) {
    this.length = length;
    this.#part = part;
  }

  /** The whole file, if the store has sent it instead of a part. */
  get content(): Uint8Array<ArrayBuffer> | null {
    return this.#content;
  }

  async read(from: number, to: number): Promise<Uint8Array> {
    if (this.#content === null) {
      const { content, whole } = await this.#part(from, to);
      if (!whole) return content;
      this.#content = content;
    }
    return this.#content.subarray(from, to);
  }
}
