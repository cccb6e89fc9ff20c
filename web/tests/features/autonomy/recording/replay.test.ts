import { afterEach, beforeEach, describe, expect, it, vi } from "vitest";
import { Replay, type Segment } from "../../../../src/features/autonomy/model/recording";
import { decodeExcerpt, decodeSegment } from "../../../../src/features/autonomy/model/recording/decode-segment";
import { memoryFile } from "../../../../src/features/autonomy/model/recording/remote-file";
import { MAX_SEGMENTS, SegmentCache } from "../../../../src/features/autonomy/model/recording/segment-cache";
import { ApiError } from "../../../../src/shared/api/http";
import type { RecordedSession, StoredSegment } from "../../../../src/shared/api/recordings";
import { FakeServer, none, ok, problem } from "../../../support/fake-server";
import { DEVICE } from "../../../support/messages";
import { EPOCH, recordedSession, rowsFrom, STARTED_TICK_NS, writeOverview, writeSegment } from "../../../support/recordings";

const SEEN_MS = STARTED_TICK_NS / 1e6 + 59_900;

/** A session of two minutes with a gap from 20 s to 30 s. */
const IMAGE = { time_s: 59.5, topic: "/frames/front", content: Uint8Array.of(1) };
const FILES = new Map([
  ["/files/0.json", writeOverview(0, 60, undefined, [20, 30])],
  ["/files/1.json", writeOverview(60, 120)],
  ["/files/0.mcap", await writeSegment({ rows: [...rowsFrom(0, 20), ...rowsFrom(30, 60)], images: [IMAGE] })],
  ["/files/1.mcap", await writeSegment({ segment: 1, rows: rowsFrom(60, 120, { seen_tick_ms: SEEN_MS }) })],
]);

describe("a replay", () => {
  let session: RecordedSession;
  let files: Map<string, Uint8Array>;
  let expired: Set<string>;
  let requests: string[];
  let replay: Replay;
  /** Ends when a segment may be decoded completely. */
  let decoding: Promise<void>;

  beforeEach(() => {
    vi.useFakeTimers();
    session = recordedSession([1, 0]);
    expired = new Set();
    requests = [];
    decoding = Promise.resolve();
    files = new Map(FILES);
    const read = (url: string): Promise<Uint8Array> => {
      requests.push(url);
      const found = files.get(url);
      return found === undefined || expired.has(url) ? Promise.reject(new ApiError(expired.has(url) ? 403 : 404, "file", "Not found.")) : Promise.resolve(found);
    };
    replay = new Replay({
      session: () => Promise.resolve({ body: session, etag: "1" }),
      file: read,
      segment: async ({ url }: StoredSegment, at_s, _, show) => {
        const file = await read(url);
        const excerpt = at_s === null ? null : await decodeExcerpt(memoryFile(file), at_s);
        if (excerpt !== null) show(excerpt);
        await decoding;
        return decodeSegment(file);
      },
      save: () => Promise.resolve("2"),
    });
  });
  afterEach(() => {
    replay.dispose();
    vi.useRealTimers();
  });

  const settle = (): Promise<unknown> => vi.advanceTimersByTimeAsync(100);
  const open = async (): Promise<void> => {
    await replay.refresh();
    await settle();
  };

  it("shows the overview first, and the rows when the segment is loaded", async () => {
    await replay.refresh();
    await Promise.resolve();
    expect(replay.moment.value.kind).toBe("none");
    await vi.advanceTimersByTimeAsync(1);
    expect(replay.moment.value).toMatchObject({ kind: "sample", index: 0 });
    await settle();
    expect(replay.moment.value).toMatchObject({ kind: "row", index: 0 });
  });

  it("shows the rows around the cursor before the whole segment is decoded, and the overview elsewhere", async () => {
    let decoded = (): void => undefined;
    decoding = new Promise((resolve) => (decoded = resolve));
    await open();
    expect(replay.moment.value).toMatchObject({ kind: "row", samples: { extent: "excerpt" } });
    replay.seek(15);
    expect(replay.moment.value.kind).toBe("sample");
    decoded();
    await settle();
    expect(replay.moment.value).toMatchObject({ kind: "row", samples: { extent: "whole" } });
  });

  it("loads the segment at the cursor and the next one, once", async () => {
    await open();
    replay.seek(10);
    replay.seek(70);
    await settle();
    expect(requests).toEqual(["/files/0.json", "/files/1.json", "/files/0.mcap", "/files/1.mcap"]);
  });

  it("has no data in a gap, before and after the segment is loaded", async () => {
    replay.seek(0);
    await replay.refresh();
    await vi.advanceTimersByTimeAsync(1);
    replay.seek(25);
    expect(replay.moment.value).toEqual({ kind: "none", reason: "gap" });
    await settle();
    expect(replay.moment.value).toEqual({ kind: "none", reason: "gap" });
    replay.seek(30);
    expect(replay.moment.value.kind).toBe("row");
  });

  it("shows the robot that the operator saw, with its age, across segments", async () => {
    await open();
    replay.seek(60.05);
    expect(replay.seen.value?.age_ms).toBeCloseTo(150, 6);
    replay.toggleSeen();
    expect(replay.shown.value).toMatchObject({ kind: "row", samples: { segment: 0 } });
    const { shown, moment } = replay;
    const position = shown.value.kind === "none" ? NaN : shown.value.samples.position_rad[shown.value.index * 2];
    expect(position).toBeCloseTo(59.9, 6);
    expect(moment.value).toMatchObject({ samples: { segment: 1 } });
    replay.seek(5);
    expect([replay.seen.value, replay.showsSeen.value]).toEqual([null, false]);
    expect(replay.shown.value).toEqual(replay.moment.value);
  });

  it("shows an image until the next one, also of the segment before, but not forever", async () => {
    await open();
    const age = (at: number): number | undefined => (replay.seek(at), replay.imageAt("/frames/front")?.age_s);
    expect([age(59.4), age(59.5), age(70)]).toEqual([undefined, 0, undefined]);
    expect(age(61)).toBeCloseTo(1.5, 9);
    expect(replay.imageAt("/frames/top")).toBeNull();
  });

  it("reads the list again when the link of a file has expired", async () => {
    expired.add("/files/0.mcap");
    const renewed = recordedSession([0, 1]);
    await replay.refresh();
    renewed.recording!.segments[0]!.url = "/files/new.mcap"; // eslint-disable-line @typescript-eslint/no-non-null-assertion
    files.set("/files/new.mcap", files.get("/files/0.mcap") ?? new Uint8Array());
    session = renewed;
    await settle();
    expect(replay.moment.value.kind).toBe("row");
  });

  it("states why a segment failed, keeps its overview, and loads it again on request", async () => {
    const file = files.get("/files/0.mcap") ?? new Uint8Array();
    files.set("/files/0.mcap", new TextEncoder().encode("<html>".repeat(9)));
    await open();
    expect([replay.segments.error(0), replay.moment.value.kind]).toEqual(["The segment is damaged.", "sample"]);
    files.set("/files/0.mcap", file);
    await replay.retry();
    await settle();
    expect([replay.segments.error(0), replay.moment.value.kind]).toEqual(["", "row"]);
  });

  it("rejects a file of another segment", async () => {
    files.set("/files/0.mcap", files.get("/files/1.mcap") ?? new Uint8Array());
    await open();
    expect(replay.segments.error(0)).toBe("The file belongs to another session or segment.");
  });

  it("shows the overview after the end of a truncated file", async () => {
    const file = files.get("/files/1.mcap") ?? new Uint8Array();
    files.set("/files/1.mcap", file.subarray(0, file.length / 2));
    await open();
    replay.seek(61);
    expect(replay.moment.value.kind).toBe("row");
    replay.seek(119);
    expect(replay.moment.value.kind).toBe("sample");
  });

  it("states why an overview failed, and continues with the others", async () => {
    files.delete("/files/0.json");
    await open();
    expect(replay.timeline.value.parts.map(({ overview }) => typeof overview)).toEqual(["string", "object"]);
    files.set("/files/0.json", writeOverview(0, 60));
    await replay.retry();
    await settle();
    expect(replay.timeline.value.parts.map(({ overview }) => typeof overview)).toEqual(["object", "object"]);
  });

  it("adds segments that are stored later without loading the others again", async () => {
    session = recordedSession([0], { complete: false });
    await open();
    session = recordedSession([0, 1]);
    await open();
    expect([replay.timeline.value.duration_s, requests.filter((url) => url === "/files/0.json").length]).toEqual([120, 1]);
  });

  it("keeps the cursor in the session and in the visible part", async () => {
    await open();
    replay.seek(500);
    expect(replay.cursor.value).toBe(120);
    replay.seek(60);
    replay.zoom(0.1, 60);
    expect(replay.window.value).toEqual({ from_s: 54, to_s: 66 });
    replay.seek(100);
    const { from_s, to_s } = replay.window.value;
    expect([to_s - from_s, from_s <= 100 && to_s >= 100]).toEqual([12, true]);
    replay.pan(-100);
    expect(replay.window.value).toEqual({ from_s: 0, to_s: 12 });
    replay.zoom(1e-9, 6);
    expect(replay.window.value).toEqual({ from_s: 5.5, to_s: 6.5 });
    replay.zoom(1e9, 6);
    expect(replay.window.value).toEqual({ from_s: 0, to_s: 120 });
  });

  it("plays at its speed, pauses at the end, and starts again from the beginning", async () => {
    await open();
    replay.seek(100);
    replay.tick(1);
    expect(replay.cursor.value).toBe(100);
    replay.setSpeed(5);
    replay.play();
    replay.tick(2);
    expect([replay.cursor.value, replay.playing.value]).toEqual([110, true]);
    replay.tick(60);
    expect([replay.cursor.value, replay.playing.value]).toEqual([120, false]);
    replay.play();
    expect([replay.cursor.value, replay.playing.value]).toEqual([0, true]);
  });
});

describe("decoded segments", () => {
  const segment = (number: number, bytes = 1): Segment => ({ segment: number, bytes, extent: "whole" }) as Segment;
  const all = (cache: SegmentCache, count: number): number[] => Array.from({ length: count }, (_, number) => number).filter((number) => cache.get(number) !== null);

  it("are bounded in number; the least recently used one goes first", async () => {
    const cache = new SegmentCache((number) => Promise.resolve(segment(number)));
    for (let number = 0; number < MAX_SEGMENTS; number += 1) {
      cache.want([number]);
      await Promise.resolve();
      await Promise.resolve();
    }
    cache.want([0, MAX_SEGMENTS]);
    await Promise.resolve();
    await Promise.resolve();
    expect(all(cache, 9)).toEqual([0, 2, 3, 4, 5, 6]);
  });

  it("are bounded in memory, but one is always kept", async () => {
    const cache = new SegmentCache((number) => Promise.resolve(segment(number, 80)), 100);
    for (const number of [0, 1]) {
      cache.want([number]);
      await Promise.resolve();
      await Promise.resolve();
    }
    expect(all(cache, 3)).toEqual([1]);
  });

  it("end loading when they are no longer wanted, and load when they are wanted again", async () => {
    const signals: AbortSignal[] = [];
    const cache = new SegmentCache((_, signal) => {
      signals.push(signal);
      return new Promise((_resolve, reject) => signal.addEventListener("abort", () => reject(signal.reason as Error)));
    });
    cache.want([0]);
    cache.want([1]);
    cache.want([0]);
    await Promise.resolve();
    expect(signals.map(({ aborted }) => aborted)).toEqual([true, true, false]);
    expect(cache.error(0)).toBe("");
    cache.dispose();
    expect(signals[2]?.aborted).toBe(true);
  });
});

describe("recordings of the server", () => {
  const PATH = `/devices/${DEVICE}/sessions/${EPOCH}`;
  let server: FakeServer;
  beforeEach(() => (server = new FakeServer()));
  afterEach(() => void vi.unstubAllGlobals());

  it("are read with their version, and episodes are saved with it", async () => {
    server.on(`GET ${PATH}`, { ...ok(recordedSession([0])), headers: { ETag: '"5"' } });
    server.on(`PUT ${PATH}/episodes`, { ...none, headers: { ETag: '"6"' } });
    const { body, etag } = await server.api.recordings.of(DEVICE, EPOCH);
    expect([body.recording?.segments.length, etag]).toEqual([1, '"5"']);
    expect(await server.api.recordings.saveEpisodes(DEVICE, EPOCH, [], etag ?? "")).toBe('"6"');
    const [call] = server.callsTo(`PUT ${PATH}/episodes`);
    expect([call?.headers["If-Match"], call?.body]).toEqual(['"5"', { episodes: [] }]);
  });

  it("report a conflict with the server's sentence", async () => {
    server.on(`PUT ${PATH}/episodes`, problem(412, "changed", "The episodes have changed."));
    await expect(server.api.recordings.saveEpisodes(DEVICE, EPOCH, [], '"1"')).rejects.toMatchObject({ status: 412, message: "The episodes have changed." });
  });

  it("are deleted on request", async () => {
    server.on(`DELETE ${PATH}/recording`, none);
    await server.api.recordings.remove(DEVICE, EPOCH);
    expect(server.callsTo(`DELETE ${PATH}/recording`).length).toBe(1);
  });
});
