/** Decoded segments, bounded in number and memory. The least recently used one is removed first. */
import { signal } from "@preact/signals-core";
import { sentence } from "../../../../shared/api/http";
import type { Segment } from "./segment";

export const MAX_SEGMENTS = 6;
const MAX_BYTES = 256 * 1024 * 1024;

/** `show` takes an excerpt before the whole segment is decoded. Throws an error whose message can be displayed. */
type Load = (segment: number, signal: AbortSignal, show: (excerpt: Segment) => void) => Promise<Segment>;

export class SegmentCache {
  readonly #load: Load;
  readonly #maxBytes: number;
  readonly #decoded = signal<ReadonlyMap<number, Segment>>(new Map());
  readonly #failed = signal<ReadonlyMap<number, string>>(new Map());
  readonly #loading = new Map<number, AbortController>();
  /** Numbers of decoded segments; the last used one is the last. */
  #used: number[] = [];
  #wanted: readonly number[] = [];

  constructor(load: Load, maxBytes = MAX_BYTES) {
    this.#load = load;
    this.#maxBytes = maxBytes;
  }

  /** A decoded segment, or an excerpt while it is being decoded; null: not loaded. Subscribes the caller to changes. */
  get(segment: number): Segment | null {
    return this.#decoded.value.get(segment) ?? null;
  }

  /** Why a segment could not be loaded, or "". Subscribes the caller to changes. */
  error(segment: number): string {
    return this.#failed.value.get(segment) ?? "";
  }

  /** Loads segments that are not loaded, one after the other, and ends loading all others. Failed ones stay failed. */
  want(segments: readonly number[]): void {
    this.#wanted = segments;
    for (const [segment, controller] of this.#loading) {
      if (!segments.includes(segment)) controller.abort();
    }
    this.#used = [...this.#used.filter((segment) => !segments.includes(segment)), ...this.#used.filter((segment) => segments.includes(segment))];
    this.#loadNext();
  }

  /** Permits failed segments to be loaded again. */
  retry(): void {
    this.#failed.value = new Map();
  }

  dispose(): void {
    this.#wanted = [];
    for (const controller of this.#loading.values()) controller.abort();
    this.#decoded.value = new Map();
  }

  /** Loads the first wanted segment that is not loaded, unless one is loading: the one at the cursor gets the whole link. */
  #loadNext(): void {
    if ([...this.#loading.values()].some(({ signal }) => !signal.aborted)) return;
    const complete = (segment: number): boolean => (this.#decoded.peek().get(segment)?.extent ?? "excerpt") !== "excerpt";
    const next = this.#wanted.find((segment) => !complete(segment) && !this.#failed.peek().has(segment));
    if (next !== undefined) void this.#fetch(next);
  }

  async #fetch(segment: number): Promise<void> {
    const controller = new AbortController();
    this.#loading.set(segment, controller);
    try {
      const keep = (found: Segment): void => {
        if (!controller.signal.aborted) this.#keep(segment, found);
      };
      keep(await this.#load(segment, controller.signal, keep));
    } catch (error) {
      if (!controller.signal.aborted) this.#failed.value = new Map(this.#failed.value).set(segment, sentence(error));
    } finally {
      if (this.#loading.get(segment) === controller) this.#loading.delete(segment);
    }
    this.#loadNext();
  }

  #keep(segment: number, found: Segment): void {
    const decoded = new Map(this.#decoded.value).set(segment, found);
    this.#used = [...this.#used.filter((one) => one !== segment), segment];
    const bytes = (): number => [...decoded.values()].reduce((sum, one) => sum + one.bytes, 0);
    while (this.#used.length > 1 && (decoded.size > MAX_SEGMENTS || bytes() > this.#maxBytes)) {
      const [oldest = segment, ...rest] = this.#used;
      decoded.delete(oldest);
      this.#used = rest;
    }
    this.#decoded.value = decoded;
  }
}
