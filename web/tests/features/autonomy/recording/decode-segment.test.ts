import { describe, expect, it } from "vitest";
import { decodeExcerpt, decodeSegment } from "../../../../src/features/autonomy/model/recording/decode-segment";
import { memoryFile } from "../../../../src/features/autonomy/model/recording/remote-file";
import { FileError, readOverview } from "../../../../src/features/autonomy/model/recording/overview";
import { nearestTo, rowOf, sampleAt, SOURCES } from "../../../../src/features/autonomy/model/recording/samples";
import { buffersOf } from "../../../../src/features/autonomy/model/recording/segment";
import { bytes } from "../../../support/messages";
import { rowsFrom, writeOverview, writeSegment } from "../../../support/recordings";

const numbers = (values: Float64Array): number[] => [...values].map((value) => Number(value.toFixed(6)));

describe("a segment", () => {
  it.each(["zstd", "", null] as const)("is read with the compression %j", async (compression) => {
    const segment = await decodeSegment(await writeSegment({ segment: 2, rows: rowsFrom(120, 121), compression }));
    expect([segment.segment, segment.time_s.length, segment.extent, segment.joints]).toEqual([2, 100, "whole", ["yaw", "pitch"]]);
    expect(numbers(segment.time_s.subarray(0, 3))).toEqual([120, 120.01, 120.02]);
    expect(numbers(rowOf(segment.position_rad, 2, 50))).toEqual([120.5, -120.5]);
    expect([numbers(rowOf(segment.requested_rad, 2, 0)), numbers(rowOf(segment.commanded_rad, 2, 0)), numbers(rowOf(segment.applied_rad, 2, 0))]).toEqual([[9, 9], [8, 8], [7, 7]]);
    expect(numbers(segment.sequence.subarray(0, 2))).toEqual([12_000, 12_001]);
  });

  it("has its sources, limits, events and images at their times", async () => {
    const rows = [...rowsFrom(0, 0.1, { source: "hold" }), ...rowsFrom(0.1, 0.2, { source: "stop", limited: ["latency", "speed"] })];
    const images = [
      { time_s: 0.05, topic: "/frames/front", content: Uint8Array.of(1, 2, 3) },
      { time_s: 0.15, topic: "/frames/front", content: Uint8Array.of(4, 5) },
      { time_s: 0.1, topic: "/frames/room/top", content: Uint8Array.of(6) },
    ];
    const segment = await decodeSegment(await writeSegment({ rows, images, events: [{ time_s: 0.12, id: "e1" }] }));
    expect([segment.source[0], segment.source[19]].map((code) => SOURCES[code ?? -1])).toEqual(["hold", "stop"]);
    expect([segment.limited[0], segment.limited[19]]).toEqual([[], ["latency", "speed"]]);
    expect(segment.events).toMatchObject([{ time_s: 0.12, event: { id: "e1", severity: "warning" } }]);
    const [front, top] = segment.images;
    expect([front?.topic, top?.topic, numbers(front?.time_s ?? new Float64Array())]).toEqual(["/frames/front", "/frames/room/top", [0.05, 0.15]]);
    expect([...(front?.data.subarray(front.offsets[1], front.offsets[2]) ?? [])]).toEqual([4, 5]);
    expect(front?.types[0]).toBe("image/jpeg");
  });

  it("is in order of time, also if its messages are not", async () => {
    const segment = await decodeSegment(await writeSegment({ rows: rowsFrom(0, 1).reverse() }));
    expect(numbers(segment.time_s.subarray(0, 2))).toEqual([0, 0.01]);
  });

  it("has no value for a value that the robot does not measure", async () => {
    const segment = await decodeSegment(await writeSegment({ rows: [{ time_s: 0, position_rad: [1, null] }] }));
    expect([...segment.position_rad]).toEqual([1, NaN]);
  });

  it("has no row in a gap", async () => {
    const segment = await decodeSegment(await writeSegment({ rows: [...rowsFrom(0, 1), ...rowsFrom(2, 3)] }));
    expect([sampleAt(segment, 0.994), sampleAt(segment, 1.5), sampleAt(segment, 1.99), sampleAt(segment, 2), sampleAt(segment, -0.1), sampleAt(segment, 3.1)]).toEqual([99, null, null, 100, null, null]);
    expect([nearestTo(segment, 1.99), nearestTo(segment, 1.5)]).toEqual([100, null]);
  });

  it.each([0.3, 0.6, 0.9])("that ends after %d of its file has the rows before, and says so", async (share) => {
    const file = await writeSegment({ rows: rowsFrom(0, 5) });
    const segment = await decodeSegment(file.subarray(0, Math.floor(file.length * share)));
    expect(segment.extent).toBe("truncated");
    expect(segment.time_s.length).toBeGreaterThan(0);
    expect(segment.time_s.length).toBeLessThanOrEqual(500);
    expect(numbers(segment.time_s)).toEqual(rowsFrom(0, 5).slice(0, segment.time_s.length).map(({ time_s }) => Number(time_s.toFixed(6))));
  });

  it("with a changed byte in a chunk is damaged", async () => {
    const file = await writeSegment({ rows: rowsFrom(0, 1) });
    const changed = file.slice();
    const field = '"setpoint_sequence":3';
    changed[Buffer.from(file).indexOf(field) + field.length - 1] = "4".charCodeAt(0);
    await expect(decodeSegment(file)).resolves.toMatchObject({ extent: "whole" });
    await expect(decodeSegment(changed)).rejects.toThrow(FileError);
  });

  it.each([
    ["is no MCAP file", bytes("<html>not found</html>".repeat(10)), "damaged"],
    ["is empty", new Uint8Array(), "ends before its first row"],
  ])("that %s is rejected with a clear message", async (_, file, message) => {
    await expect(decodeSegment(file)).rejects.toThrow(FileError);
    await expect(decodeSegment(file)).rejects.toThrow(message);
  });

  it("with rows of another robot is rejected", async () => {
    const file = await writeSegment({ rows: rowsFrom(0, 1), metadata: { joints: ["yaw"] } });
    await expect(decodeSegment(file)).rejects.toThrow("A row has 2 joints instead of 1.");
  });

  it.each([0, 2.5, 4.99, 60])("has an excerpt around %d s that equals its rows", async (at) => {
    const file = await writeSegment({ rows: rowsFrom(0, 5), events: [{ time_s: 1, id: "e1" }] });
    const [whole, excerpt] = [await decodeSegment(file), await decodeExcerpt(memoryFile(file), at)];
    const first = whole.time_s.indexOf(excerpt?.time_s[0] ?? NaN);
    const count = excerpt?.time_s.length ?? 0;
    expect([excerpt?.extent, count > 0 && count < 50]).toEqual(["excerpt", true]);
    expect(excerpt?.position_rad).toEqual(whole.position_rad.slice(2 * first, 2 * (first + count)));
    if (at < 5) expect(excerpt && sampleAt(excerpt, at)).not.toBeNull();
  });

  it.each([null, "zstd"] as const)("without an index has no excerpt (compression %j)", async (compression) => {
    const file = await writeSegment({ rows: rowsFrom(0, 1), compression });
    expect(await decodeExcerpt(memoryFile(compression === null ? file : file.subarray(0, file.length - 1)), 0.5)).toBeNull();
    expect(await decodeExcerpt(memoryFile(new Uint8Array(5)), 0.5)).toBeNull();
  });

  it("is no longer decoded after an abort", async () => {
    const file = await writeSegment({ rows: rowsFrom(0, 20) });
    const controller = new AbortController();
    let pauses = 0;
    const pause = (): Promise<void> => {
      pauses += 1;
      if (pauses === 2) controller.abort();
      controller.signal.throwIfAborted();
      return Promise.resolve();
    };
    await expect(decodeSegment(file, pause)).rejects.toMatchObject({ name: "AbortError" });
    expect(pauses).toBe(2);
  });

  it("lists each buffer once, to move it between threads", async () => {
    const image = { time_s: 0, topic: "/frames/front", content: Uint8Array.of(1) };
    const segment = await decodeSegment(await writeSegment({ rows: rowsFrom(0, 1), images: [image] }));
    const buffers = buffersOf(segment);
    expect(new Set(buffers).size).toBe(buffers.length);
    expect(buffers).toContain(segment.position_rad.buffer);
    expect(buffers).toContain(segment.images[0]?.data.buffer);
    expect(segment.bytes).toBe(buffers.reduce((sum, { byteLength }) => sum + byteLength, 0));
  });
});

describe("an overview", () => {
  it("is read in columns", () => {
    const overview = readOverview(writeOverview(60, 61, (time) => (time < 60.5 ? "movement" : "hold")));
    expect([numbers(overview.time_s), [...overview.source]]).toEqual([[60, 60.2, 60.4, 60.6, 60.8], [1, 1, 1, 2, 2]]);
    expect(numbers(rowOf(overview.position_rad, 2, 1))).toEqual([60.2, -60.2]);
  });

  it.each([
    ["no JSON", "<html>", "not valid JSON"],
    ["columns of different length", { joints: [], time_s: [1], position_rad: [], applied_rad: [], source: [], mode: [] }, "different lengths"],
    ["no columns", {}, "different lengths"],
    ["rows of different length", { joints: ["a"], time_s: [1], position_rad: [[1, 2]], applied_rad: [[1]], source: ["hold"], mode: ["idle"] }, "2 joints"],
    ["an unknown source", { joints: [], time_s: [1], position_rad: [[]], applied_rad: [[]], source: ["x"], mode: ["idle"] }, "does not know"],
  ])("with %s is rejected with a clear message", (_, content, message) => {
    expect(() => readOverview(bytes(content))).toThrow(FileError);
    expect(() => readOverview(bytes(content))).toThrow(message);
  });
});
