/** Decides which parts of a live view are current. */
import { currentFrame, type LatestFrame } from "../../devices/model";
import type { KnownPeople } from "../../../shared/mqtt/sensor-frames";

/** A stream of frames and its newest one. */
export interface LiveStream<T> {
  latest: LatestFrame<T> | null;
  /** Declared rate [Hz]. */
  rateHz: number;
}

interface DepthView {
  /** Whether the newest frame of the picture is late. */
  stalled: boolean;
  /** People who are drawn now; `null`: not known, or not for this picture. */
  overlay: KnownPeople | null;
}

/** What a depth card shows. `running`: it shows live frames; a stream is `null` if the device does not have it. */
export function depthView(running: boolean, depth: LiveStream<unknown> | null, people: LiveStream<KnownPeople> | null, atMs: number): DepthView {
  const picture = depth ?? people;
  if (!running || picture === null) return { stalled: false, overlay: null };
  const late = isLate(picture, atMs);
  // Skeletons of another moment than the picture would be misleading.
  const tracked = late || people === null ? null : currentFrame(people.latest, people.rateHz, atMs);
  return { stalled: late && picture.latest !== null, overlay: tracked?.value ?? null };
}

interface ScanView {
  /** Where the dots come from, or why there are none. */
  dots: "captured" | "live" | "waiting" | "stalled" | "none";
  /** Whether the view is no longer current. */
  old: boolean;
}

/** What a lidar card shows. `sectorsLate`: `null` without sectors; `stream`: `null` without live scans. */
export function scanView(captured: boolean, stream: LiveStream<unknown> | null, sectorsLate: boolean | null, atMs: number): ScanView {
  const dots = captured ? "captured" : stream === null ? "none" : stream.latest === null ? "waiting" : isLate(stream, atMs) ? "stalled" : "live";
  return { dots, old: sectorsLate ?? dots === "stalled" };
}

function isLate({ latest, rateHz }: LiveStream<unknown>, atMs: number): boolean {
  return currentFrame(latest, rateHz, atMs) === null;
}
