/** Reads the newest frame of a stream, one at a time. */
import { sentence } from "../../../shared/api/http";
import { Arrivals, lateAfterMs } from "../../../shared/lib/arrivals";
import { now } from "../../../shared/lib/clock";
import type { CameraFrame, FrameKind } from "../../../shared/mqtt/camera-frame";
import type { DeviceStore } from "./device-store";

export interface LatestFrame<T> {
  value: T;
  sequence: number;
  /** Arrival of this frame on the page's clock [ms]. */
  at: number;
  /** Period of the stream when this frame arrived [ms]; `null` if not yet known. */
  everyMs: number | null;
  /** Measured rate [Hz]. */
  rateHz: number;
}

export interface Frames<T> {
  /** `null` before the first, and after the end of the subscription. */
  latest: LatestFrame<T> | null;
  /** Why the newest frame is not shown, or "". */
  error: string;
}

export const NO_FRAMES: Frames<never> = { latest: null, error: "" };

type Read<T> = (content: Uint8Array) => T | Promise<T>;

/** The frame unless it is late for a stream of this rate; `null` if it is, or if there is none. */
export function currentFrame<T>(latest: LatestFrame<T> | null, rateHz: number, atMs: number): LatestFrame<T> | null {
  return latest !== null && atMs - latest.at <= lateAfterMs(rateHz, latest.everyMs) ? latest : null;
}

/**
 * Subscribes to a stream and publishes its newest frame. While `read` works on a frame, only the newest of those that
 * arrive is kept. Returns a function that unsubscribes and publishes `NO_FRAMES`; nothing is published after it.
 */
export function followFrames<T>(
  device: DeviceStore,
  name: string,
  kind: FrameKind,
  read: Read<T>,
  publish: (frames: Frames<T>) => void,
): () => void {
  const reader = new FrameReader(read, publish);
  const end = device.watchFrames(name, kind, (frame) => reader.push(frame));
  return () => {
    end();
    reader.end();
    publish(NO_FRAMES);
  };
}

interface Waiting {
  frame: CameraFrame;
  at: number;
  everyMs: number | null;
}

class FrameReader<T> {
  readonly #read: Read<T>;
  readonly #publish: (frames: Frames<T>) => void;
  readonly #arrivals = new Arrivals();
  #next: Waiting | null = null;
  #latest: LatestFrame<T> | null = null;
  #busy = false;
  #ended = false;

  constructor(read: Read<T>, publish: (frames: Frames<T>) => void) {
    this.#read = read;
    this.#publish = publish;
  }

  push(frame: CameraFrame): void {
    const at = now();
    this.#arrivals.add(at);
    this.#next = { frame, at, everyMs: this.#arrivals.everyMs };
    if (!this.#busy) void this.#work();
  }

  end(): void {
    this.#next = null;
    this.#ended = true;
  }

  async #work(): Promise<void> {
    this.#busy = true;
    for (let next = this.#next; next !== null; next = this.#next) {
      const { frame, at, everyMs } = next;
      this.#next = null;
      let error = "";
      try {
        const value = await this.#read(frame.content);
        this.#latest = { value, sequence: frame.sequence, at, everyMs, rateHz: this.#arrivals.rateHz(now()) };
      } catch (failure) {
        error = sentence(failure);
      }
      if (!this.#ended) this.#publish({ latest: this.#latest, error });
    }
    this.#busy = false;
  }
}
