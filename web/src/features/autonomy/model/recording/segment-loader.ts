/** Loads segments with a web worker. */
import { ApiError } from "../../../../shared/api/http";
import type { StoredSegment } from "../../../../shared/api/recordings";
import { FileError } from "./overview";
import type { Segment } from "./segment";

/** `url` null: aborts the call. */
export interface WorkerCall {
  id: number;
  url: string | null;
  /** Of the file [bytes]. */
  length: number;
  /** Time around which an excerpt is decoded first [s]; null: none. */
  at_s: number | null;
}

/** `status`: HTTP status of a failed download; null: the file cannot be read. */
export type WorkerResult = { id: number; segment: Segment } | { id: number; excerpt: Segment } | { id: number; status: number | null; error: string };

interface Waiting {
  resolve: (segment: Segment) => void;
  reject: (error: Error) => void;
  show: (excerpt: Segment) => void;
}

export class SegmentLoader {
  readonly #worker: Worker;
  readonly #waiting = new Map<number, Waiting>();
  #calls = 0;

  constructor() {
    this.#worker = new Worker(new URL("./segment-worker.ts", import.meta.url), { type: "module" });
    this.#worker.addEventListener("message", ({ data }: MessageEvent<WorkerResult>) => this.#settle(data));
    this.#worker.addEventListener("error", () => {
      for (const { reject } of this.#waiting.values()) reject(new FileError("The program that reads recordings failed. Reload the page."));
      this.#waiting.clear();
    });
  }

  /** The content of a segment. Throws `FileError` or `ApiError`, and the reason of `signal` after an abort. */
  load({ url, length }: StoredSegment, at_s: number | null, signal: AbortSignal, show: (excerpt: Segment) => void): Promise<Segment> {
    const id = ++this.#calls;
    return new Promise((resolve, reject) => {
      this.#waiting.set(id, { resolve, reject, show });
      signal.addEventListener("abort", () => {
        if (!this.#waiting.delete(id)) return;
        this.#send({ id, url: null, length, at_s });
        reject(signal.reason as Error);
      });
      this.#send({ id, url, length, at_s });
    });
  }

  dispose(): void {
    this.#worker.terminate();
  }

  #send(call: WorkerCall): void {
    this.#worker.postMessage(call);
  }

  #settle(result: WorkerResult): void {
    const waiting = this.#waiting.get(result.id);
    if ("excerpt" in result) {
      waiting?.show(result.excerpt);
      return;
    }
    this.#waiting.delete(result.id);
    if ("segment" in result) waiting?.resolve(result.segment);
    else waiting?.reject(result.status === null ? new FileError(result.error) : new ApiError(result.status, "file", result.error));
  }
}
