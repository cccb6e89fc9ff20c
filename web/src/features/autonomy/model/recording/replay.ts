/** The replay of one recorded session: what is loaded, the cursor, and the robot's state at the cursor. */
import { computed, effect, signal, type ReadonlySignal } from "@preact/signals-core";
import { ApiError, sentence, type Tagged } from "../../../../shared/api/http";
import type { RecordedSession, StoredSegment } from "../../../../shared/api/recordings";
import { clamp } from "../../../../shared/lib/angles";
import { now } from "../../../../shared/lib/clock";
import { Episodes, type SaveEpisodes } from "./episodes";
import { readOverview } from "./overview";
import { indexAt, nearestTo, sampleAt, type Samples } from "./samples";
import type { Images, Segment } from "./segment";
import { SegmentCache } from "./segment-cache";
import { EMPTY, type Gap, gapsOf, type LoadedOverview, partAt, type Timeline, timelineOf } from "./timeline";
import { type EventList, eventsOf } from "./timeline-events";

/** What a replay reads. All throw errors whose messages can be displayed. */
export interface Sources {
  session: () => Promise<Tagged<RecordedSession>>;
  file: (url: string, signal: AbortSignal) => Promise<Uint8Array>;
  /** `show` takes an excerpt around `at_s` [s] before the whole segment is decoded; null: no excerpt. */
  segment: (info: StoredSegment, at_s: number | null, signal: AbortSignal, show: (excerpt: Segment) => void) => Promise<Segment>;
  save: SaveEpisodes;
}

/** The recorded state at one time. Until the rows are loaded, it is a sample of the overview. */
export type Moment =
  | { kind: "row"; samples: Segment; index: number }
  | { kind: "sample"; samples: Samples; index: number }
  | { kind: "none"; reason: "gap" | "loading" | "failed" };

export interface Range {
  from_s: number;
  to_s: number;
}

/** The telemetry that the operator had seen when sending the command of a row. */
export interface Seen {
  time_s: number;
  /** Its age at the row [ms]. */
  age_ms: number;
}

export const SPEEDS = [0.25, 0.5, 1, 2, 5, 10, 30] as const;
const SHORTEST_WINDOW_S = 1;
/** Overviews that load at the same time. */
const PARALLEL = 6;
/** In a quick search, a shorter stay in a segment does not load it [ms]. */
const SETTLED_MS = 40;
/** After this time in one segment, a change is no quick search [ms]. */
const RESTED_MS = 300;
/** An image is shown until the next one, at most for this long [s]. */
const IMAGE_VALID_S = 2;
/** Responses of a store whose links have expired. */
const EXPIRED: readonly number[] = [401, 403, 404, 410];

export class Replay {
  readonly #sources: Sources;
  readonly #ended = new AbortController();
  readonly #overviews = new Map<number, LoadedOverview>();
  readonly #session = signal<RecordedSession | null>(null);
  readonly #error = signal("");
  readonly #timeline = signal<Timeline>(EMPTY);
  readonly #cursor = signal(0);
  readonly #window = signal<Range | null>(null);
  readonly #playing = signal(false);
  readonly #speed = signal(1);
  readonly #dragged = signal(false);
  readonly #showsSeen = signal(false);
  readonly #disposeWants: () => void;
  readonly segments: SegmentCache;
  readonly episodes: Episodes;

  readonly session: ReadonlySignal<RecordedSession | null> = this.#session;
  /** Why the session could not be loaded, or "". */
  readonly error: ReadonlySignal<string> = this.#error;
  readonly timeline: ReadonlySignal<Timeline> = this.#timeline;
  /** Since the start of the session [s]. */
  readonly cursor: ReadonlySignal<number> = this.#cursor;
  readonly playing: ReadonlySignal<boolean> = this.#playing;
  readonly speed: ReadonlySignal<number> = this.#speed;
  /** Whether the cursor moves continuously: it is dragged, or the recording plays. */
  readonly moving = computed<boolean>(() => this.#dragged.value || this.#playing.value);
  /** The visible part of the time axis. */
  readonly window = computed<Range>(() => this.#window.value ?? { from_s: 0, to_s: Math.max(SHORTEST_WINDOW_S, this.#timeline.value.duration_s) });
  readonly events = computed<EventList>(() => eventsOf(this.#timeline.value, (segment) => this.segments.get(segment)));
  /** Times without data, and why. */
  readonly gaps = computed<readonly Gap[]>(() => (this.#session.value === null ? [] : gapsOf(this.#session.value, this.#timeline.value, this.events.value.events)));
  /** The state at the cursor. */
  readonly moment = computed<Moment>(() => this.#momentAt(this.#cursor.value, sampleAt));
  /** What the operator had seen at the cursor; null: the row has no setpoint of an operator. */
  readonly seen = computed<Seen | null>(() => seenAt(this.moment.value));
  /** Whether twin and images show what the operator had seen. */
  readonly showsSeen = computed<boolean>(() => this.#showsSeen.value && this.seen.value !== null);
  /** The state that twin and images show. */
  readonly shown = computed<Moment>(() => {
    const seen = this.showsSeen.value ? this.seen.value : null;
    return seen === null ? this.moment.value : this.#momentAt(seen.time_s, nearestTo);
  });

  constructor(sources: Sources) {
    this.#sources = sources;
    this.segments = new SegmentCache((segment, signal, show) => this.#loadSegment(segment, signal, show));
    this.episodes = new Episodes(sources.save, async () => {
      await this.refresh();
      if (this.#error.value !== "") throw new Error(this.#error.value);
    });
    let timer: ReturnType<typeof setTimeout> | undefined;
    let changedAt = -Infinity;
    const wanted = computed(() => this.#wanted().join());
    const disposeEffect = effect(() => {
      const segments = wanted.value === "" ? [] : wanted.value.split(",").map(Number);
      const rested = now() - changedAt > RESTED_MS;
      changedAt = now();
      clearTimeout(timer);
      timer = setTimeout(() => this.segments.want(segments), rested ? 0 : SETTLED_MS);
    });
    this.#disposeWants = () => {
      disposeEffect();
      clearTimeout(timer);
    };
  }

  /** Reads the session, and the overviews of segments that are new or failed before. */
  async refresh(): Promise<void> {
    try {
      const { body, etag } = await this.#sources.session();
      if (this.#ended.signal.aborted) return;
      this.#session.value = body;
      this.#error.value = "";
      this.episodes.adopt(body.recording?.episodes ?? [], etag);
    } catch (error) {
      this.#error.value = sentence(error);
      return;
    }
    void this.#loadOverviews();
  }

  /** Tries again what failed. */
  async retry(): Promise<void> {
    for (const [segment, overview] of this.#overviews) {
      if (typeof overview === "string") this.#overviews.delete(segment);
    }
    this.segments.retry();
    await this.refresh();
    this.segments.want(this.#wanted());
  }

  dispose(): void {
    this.#ended.abort();
    this.#disposeWants();
    this.segments.dispose();
  }

  /** Moves the cursor, and the visible part of the axis if it does not contain the cursor. */
  seek(at_s: number): void {
    const cursor = clamp(at_s, 0, this.#timeline.value.duration_s);
    this.#cursor.value = cursor;
    const { from_s, to_s } = this.window.value;
    if (cursor >= from_s && cursor <= to_s) return;
    this.#show(cursor - (to_s - from_s) * (cursor > to_s ? 0.1 : 0.9), to_s - from_s);
  }

  /** Starts or ends moving the cursor with a pointer. */
  drag(active: boolean): void {
    this.#dragged.value = active;
  }

  play(): void {
    if (this.#cursor.value >= this.#timeline.value.duration_s) this.seek(0);
    this.#playing.value = true;
  }

  pause(): void {
    this.#playing.value = false;
  }

  setSpeed(speed: number): void {
    this.#speed.value = speed;
  }

  /** Advances the cursor by the page's time [s] while playing, and pauses at the end. */
  tick(elapsed_s: number): void {
    if (!this.#playing.value) return;
    this.seek(this.#cursor.value + elapsed_s * this.#speed.value);
    if (this.#cursor.value >= this.#timeline.value.duration_s) this.pause();
  }

  /** Multiplies the length of the visible part. The time `around_s` keeps its place. */
  zoom(factor: number, around_s: number): void {
    const { from_s, to_s } = this.window.value;
    const length = clamp((to_s - from_s) * factor, SHORTEST_WINDOW_S, Math.max(SHORTEST_WINDOW_S, this.#timeline.value.duration_s));
    this.#show(around_s - ((around_s - from_s) / (to_s - from_s)) * length, length);
  }

  /** Moves the visible part by a fraction of its length. */
  pan(fraction: number): void {
    const { from_s, to_s } = this.window.value;
    this.#show(from_s + (to_s - from_s) * fraction, to_s - from_s);
  }

  showAll(): void {
    this.#window.value = null;
  }

  toggleSeen(): void {
    this.#showsSeen.value = !this.#showsSeen.value;
  }

  /** The image of a camera that is valid at the shown time; `age_s`: how long before that time it was recorded. */
  imageAt(topic: string): { images: Images; index: number; age_s: number } | null {
    const at_s = this.showsSeen.value ? (this.seen.value?.time_s ?? 0) : this.#cursor.value;
    const timeline = this.#timeline.value;
    const newest = timeline.parts.findLastIndex(({ start_s }) => start_s <= at_s);
    for (const part of [timeline.parts[newest], timeline.parts[newest - 1]]) {
      const images = part && this.segments.get(part.info.segment)?.images.find((one) => one.topic === topic);
      const index = images === undefined ? -1 : indexAt(images.time_s, at_s);
      const age_s = at_s - (images?.time_s[index] ?? -Infinity);
      if (images !== undefined && age_s <= IMAGE_VALID_S) return { images, index, age_s };
    }
    return null;
  }

  /** All rows between two times [s], in segments in order of time. Throws errors whose messages can be displayed. */
  async segmentsBetween(from_s: number, to_s: number): Promise<Segment[]> {
    const chosen = this.#timeline.value.parts.filter(({ start_s, end_s }) => start_s <= to_s && end_s >= from_s);
    const found: Segment[] = [];
    for (const { info } of chosen) found.push(await this.#loadSegment(info.segment, this.#ended.signal, () => undefined));
    return found;
  }

  #show(from_s: number, length_s: number): void {
    const { duration_s } = this.#timeline.value;
    const from = clamp(from_s, 0, Math.max(0, duration_s - length_s));
    this.#window.value = length_s >= duration_s ? null : { from_s: from, to_s: from + length_s };
  }

  /** The segment at the cursor, and the next one. */
  #wanted(): number[] {
    const timeline = this.#timeline.value;
    const part = partAt(timeline, this.#cursor.value);
    if (part === null) return timeline.parts.slice(0, 1).map(({ info }) => info.segment);
    const index = timeline.parts.indexOf(part);
    return timeline.parts.slice(index, index + 2).map(({ info }) => info.segment);
  }

  #momentAt(at_s: number, find: (samples: Samples, at_s: number) => number | null): Moment {
    const part = partAt(this.#timeline.value, at_s);
    if (part === null) return { kind: "none", reason: this.#timeline.value === EMPTY ? "loading" : "gap" };
    const segment = this.segments.get(part.info.segment);
    if (segment !== null) {
      const index = find(segment, at_s);
      if (index !== null) return { kind: "row", samples: segment, index };
      // The other rows of an excerpt or a truncated file are only in the overview.
      if (segment.extent === "whole") return { kind: "none", reason: "gap" };
    }
    const { overview } = part;
    if (typeof overview === "string") return { kind: "none", reason: "failed" };
    if (overview === null) return { kind: "none", reason: at_s <= part.end_s ? "loading" : "gap" };
    const index = find(overview, at_s);
    return index === null ? { kind: "none", reason: "gap" } : { kind: "sample", samples: overview, index };
  }

  async #loadOverviews(): Promise<void> {
    this.#rebuild();
    const missing = this.#timeline.value.parts.filter(({ overview, info }) => overview === null && !this.#overviews.has(info.segment));
    for (const { info } of missing) this.#overviews.set(info.segment, null);
    for (let index = 0; index < missing.length; index += PARALLEL) {
      await Promise.all(missing.slice(index, index + PARALLEL).map(({ info }) => this.#loadOverview(info)));
      if (this.#ended.signal.aborted) return;
      this.#rebuild();
    }
  }

  async #loadOverview({ segment, overview_url: url }: StoredSegment): Promise<void> {
    try {
      this.#overviews.set(segment, readOverview(await this.#sources.file(url, this.#ended.signal)));
    } catch (error) {
      if (!this.#ended.signal.aborted) this.#overviews.set(segment, sentence(error));
    }
  }

  #rebuild(): void {
    const session = this.#session.value;
    if (session !== null) this.#timeline.value = timelineOf(session, this.#overviews);
  }

  /** Links to files expire: after a refusal, the list is read again once. */
  async #loadSegment(segment: number, signal: AbortSignal, show: (excerpt: Segment) => void): Promise<Segment> {
    const load = async (): Promise<Segment> => {
      const at_s = partAt(this.#timeline.value, this.#cursor.value)?.info.segment === segment ? this.#cursor.value : null;
      const found = await this.#sources.segment(this.#infoOf(segment), at_s, signal, (excerpt) => show(this.#checked(excerpt, segment)));
      return this.#checked(found, segment);
    };
    try {
      return await load();
    } catch (error) {
      if (!(error instanceof ApiError) || !EXPIRED.includes(error.status)) throw error;
      await this.refresh();
      return load();
    }
  }

  #infoOf(segment: number): StoredSegment {
    const info = this.#session.value?.recording?.segments.find((one) => one.segment === segment);
    if (info === undefined) throw new ApiError(404, "file", "The segment is no longer stored.");
    return info;
  }

  #checked(found: Segment, segment: number): Segment {
    if (found.segment !== segment || found.epoch !== this.#session.value?.epoch) throw new Error("The file belongs to another session or segment.");
    return found;
  }
}

function seenAt(moment: Moment): Seen | null {
  if (moment.kind !== "row") return null;
  const { samples, index } = moment;
  const tickMs = samples.seen_tick_ms[index] ?? 0;
  if (tickMs === 0) return null;
  const time_s = (tickMs - samples.started_tick_ms) / 1000;
  return { time_s, age_ms: ((samples.time_s[index] ?? time_s) - time_s) * 1000 };
}
