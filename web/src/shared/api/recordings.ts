/** Recordings of sessions over the HTTP API. */
import type { StoredSession } from "./autonomy";
import { ApiError, type Http, type Tagged } from "./http";

export type Outcome = "success" | "failure";

/** A part of a session with one attempt at a task. Times are since the start of the session [s]. */
export interface Episode {
  start_s: number;
  end_s: number;
  /** null: not rated. */
  outcome: Outcome | null;
  label: string;
  note: string;
}

/** One stored MCAP file. */
export interface StoredSegment {
  /** Number in the session, from 0. */
  segment: number;
  started_at: string;
  ended_at: string;
  /** [bytes] */
  length: number;
  sha256: string;
  url: string;
  overview_url: string;
}

export interface Recording {
  segments: StoredSegment[];
  /** Topics of recorded cameras. */
  cameras: string[];
  episodes: Episode[];
  /** Whether the session has ended and all its segments are stored. */
  complete: boolean;
  /** Segments that are not stored. */
  missing: MissingSegment[];
  /** Whether nothing new can arrive, also if segments are missing. */
  final: boolean;
}

/** `waiting`: the agent will upload it. `lost`: it does not have it. `unknown`: an older agent does not name what it has. */
export interface MissingSegment {
  segment: number;
  cause: "waiting" | "lost" | "unknown";
}

export interface RecordedSession extends StoredSession {
  /** null: nothing was recorded, or it was deleted. */
  recording: Recording | null;
}

/** The owner's decision which cameras may be recorded. */
export interface StoredCameraConsent {
  cameras: string[];
  /** Whether the device has stored the decision. */
  confirmed: boolean;
  /** Why the device rejected it. */
  reason: { code: string; message: string } | null;
}

/** All methods throw only `ApiError`. */
export class RecordingsApi {
  readonly #http: Http;

  constructor(http: Http) {
    this.#http = http;
  }

  /** A session with its recording. The ETag is that of the episodes. */
  of(device: string, epoch: number): Promise<Tagged<RecordedSession>> {
    return this.#http.tagged("GET", path(device, epoch));
  }

  /** Replaces all episodes unless they changed after `etag`. Returns the new ETag. */
  async saveEpisodes(device: string, epoch: number, episodes: readonly Episode[], etag: string): Promise<string | null> {
    const headers = { "If-Match": etag };
    return (await this.#http.tagged("PUT", `${path(device, epoch)}/episodes`, { body: { episodes }, headers })).etag;
  }

  /** Decides which cameras of a device may be recorded. For owners. */
  setCameraConsent(device: string, cameras: readonly string[]): Promise<StoredCameraConsent> {
    const waitMs = 5000;
    return this.#http.call("PUT", `/devices/${device}/camera-consent`, { body: { cameras, wait_ms: waitMs }, waitMs });
  }

  /** Deletes the recording. For owners. */
  async remove(device: string, epoch: number): Promise<void> {
    await this.#http.call("DELETE", `${path(device, epoch)}/recording`);
  }
}

/** The content of a stored file. Throws `ApiError`, and `AbortError` after an abort. */
export async function storedFile(url: string, signal: AbortSignal): Promise<Uint8Array<ArrayBuffer>> {
  return (await download(url, {}, signal)).content;
}

/** Bytes `from` to `to` of a stored file, or the whole file from a store that cannot send a part. Throws as `storedFile`. */
export async function storedPart(url: string, from: number, to: number, signal: AbortSignal): Promise<{ content: Uint8Array<ArrayBuffer>; whole: boolean }> {
  const { content, status } = await download(url, { Range: `bytes=${from}-${to - 1}` }, signal);
  return { content, whole: status !== PARTIAL_CONTENT };
}

const PARTIAL_CONTENT = 206;

async function download(url: string, headers: Record<string, string>, signal: AbortSignal): Promise<{ content: Uint8Array<ArrayBuffer>; status: number }> {
  let response: Response;
  try {
    response = await fetch(url, { credentials: "same-origin", headers, signal });
    if (response.ok) return { content: new Uint8Array(await response.arrayBuffer()), status: response.status };
  } catch {
    signal.throwIfAborted();
    throw new ApiError(0, "unreachable", "The store of the recordings cannot be reached.");
  }
  throw new ApiError(response.status, "file", `The store of the recordings responded with status ${response.status}.`);
}

function path(device: string, epoch: number): string {
  return `/devices/${device}/sessions/${epoch}`;
}
