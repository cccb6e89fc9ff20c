/** Recordings as the agent writes them: MCAP segments and overviews of a session that started at 0 s. */
import { McapWriter } from "@mcap/core";
import type { RecordedSession, StoredSegment } from "../../src/shared/api/recordings";
import { bytes } from "./messages";

export const JOINTS = ["yaw", "pitch"];
export const EPOCH = 7;
/** Later than 2^53 ns, as real times are. */
export const STARTED_NS = 1_772_359_200_000_000_001n;
export const STARTED_TICK_NS = 5_000_000_000;
export const PERIOD_S = 0.01;

interface Row {
  time_s: number;
  /** Number of the control period; by default that of a robot that is never late. */
  sequence?: number;
  source?: string;
  position_rad?: (number | null)[];
  requested_rad?: number[];
  seen_tick_ms?: number;
  limited?: string[];
}

interface SegmentContents {
  segment?: number;
  rows?: Row[];
  events?: { time_s: number; id: string }[];
  images?: { time_s: number; topic: string; content: Uint8Array }[];
  metadata?: Record<string, unknown>;
  /** null: without chunks, as a segment that is being written. */
  compression?: "zstd" | "" | null;
}

/** Rows from a time to another, one in each period. */
export function rowsFrom(from_s: number, to_s: number, more: Partial<Row> = {}): Row[] {
  return Array.from({ length: Math.round((to_s - from_s) / PERIOD_S) }, (_, index) => ({ time_s: from_s + index * PERIOD_S, ...more }));
}

export async function writeSegment({ segment = 0, rows = [], events = [], images = [], compression = "zstd", ...rest }: SegmentContents): Promise<Uint8Array> {
  const output = new MemoryFile();
  const compressChunk = (data: Uint8Array): { compression: string; compressedData: Uint8Array } =>
    compression === "zstd" ? { compression, compressedData: storedAsZstd(data) } : { compression: "", compressedData: data };
  const writer = new McapWriter({ writable: output, useChunks: compression !== null, chunkSize: 4096, compressChunk });
  await writer.start({ profile: "telescope", library: "" });
  const info = {
    version: 1, device: "arm", robot_type: "ur5", robot_type_version: 1, epoch: EPOCH, segment, holder: "Ann", joints: JOINTS, period_ms: 10,
    cameras: [], started_tick_ns: STARTED_TICK_NS, simulated: true, software: "1", ...rest.metadata,
  };
  const fields = Object.entries(info).map(([name, value]): [string, string] => [name, JSON.stringify(value)]);
  await writer.addMetadata({ name: "telescope", metadata: new Map([...fields, ["started_ns", String(STARTED_NS)]]) });
  const schemaId = await writer.registerSchema({ name: "any", encoding: "jsonschema", data: bytes("{}") });
  const channels = new Map<string, number>();
  const add = async (topic: string, time_s: number, message: object): Promise<void> => {
    const channelId = channels.get(topic) ?? (await writer.registerChannel({ topic, schemaId, messageEncoding: "json", metadata: new Map() }));
    channels.set(topic, channelId);
    const logTime = STARTED_NS + BigInt(Math.round(time_s * 1e9));
    await writer.addMessage({ channelId, sequence: 0, logTime, publishTime: logTime, data: bytes(message) });
  };
  for (const row of rows) await add("/control", row.time_s, controlRow(row));
  for (const { time_s, id } of events) {
    await add("/events", time_s, { id, device: "arm", at_ms: 1, kind: "motion-held", severity: "warning", message: "Held" });
  }
  for (const { time_s, topic, content } of images) {
    await add(topic, time_s, { timestamp: { sec: 0, nsec: 0 }, frame_id: "", format: "jpeg", data: Buffer.from(content).toString("base64") });
  }
  await writer.end();
  return output.content();
}

function controlRow({ time_s, sequence = Math.round(time_s / PERIOD_S), source = "operator", position_rad = [time_s, -time_s], requested_rad = [9, 9], seen_tick_ms = 0, limited = [] }: Row): object {
  return {
    tick_ns: STARTED_TICK_NS + Math.round(time_s * 1e9), at_ms: 0, sequence, epoch: EPOCH, mode: "streaming", source,
    position_rad, velocity_rad_s: [0, 0], effort_nm: [0, 0], requested_rad, commanded_rad: [8, 8], applied_rad: [7, 7],
    twist: [0, 0, 0], setpoint_sequence: 3, seen_tick_ms, loop_age_ms: 40, limited,
  };
}

/** Samples every 0.2 s from a time to another, without those of `gap`. */
export function writeOverview(from_s: number, to_s: number, source: (time_s: number) => string = () => "operator", gap: readonly [number, number] = [0, 0], more: object = {}): Uint8Array {
  const times = Array.from({ length: Math.round((to_s - from_s) * 5) }, (_, index) => from_s + index / 5).filter((time) => time < gap[0] || time >= gap[1]);
  return bytes({
    joints: JOINTS, time_s: times, position_rad: times.map((time) => [time, -time]), applied_rad: times.map(() => [7, 7]),
    source: times.map(source), mode: times.map(() => "streaming"), ...more,
  });
}

const at = (seconds: number): string => new Date(Number(STARTED_NS / 1_000_000n) + seconds * 1000).toISOString();

export function storedSegment(segment: number): StoredSegment {
  const [started_at, ended_at] = [at(segment * 60), at(segment * 60 + 60)];
  return { segment, started_at, ended_at, length: 1, sha256: "", url: `/files/${segment}.mcap`, overview_url: `/files/${segment}.json` };
}

export function recordedSession(segments: readonly number[], more: Partial<RecordedSession["recording"]> = {}): RecordedSession {
  return {
    epoch: EPOCH, holder: "Ann", action: null, task: null, outcome: null, intervened: false, started_at: at(0), ended_at: null,
    share: { operator_s: 0, machine_s: 0, hti: null, mti: null, mtia: null }, recorded: true,
    recording: { segments: segments.map(storedSegment), cameras: [], episodes: [], complete: true, missing: [], final: true, ...more },
  };
}

class MemoryFile {
  readonly #parts: Uint8Array[] = [];
  #length = 0;

  write(part: Uint8Array): Promise<void> {
    this.#parts.push(part.slice());
    this.#length += part.length;
    return Promise.resolve();
  }

  position(): bigint {
    return BigInt(this.#length);
  }

  content(): Uint8Array {
    return new Uint8Array(Buffer.concat(this.#parts));
  }
}

const MAX_BLOCK_BYTES = 1 << 17;

/** A zstd frame with stored blocks (RFC 8878, 3.1.1.2.2): Node.js 20 has no zstd compressor. */
function storedAsZstd(data: Uint8Array): Uint8Array {
  const header = Buffer.from([0x28, 0xb5, 0x2f, 0xfd, 0xa0, 0, 0, 0, 0]);
  header.writeUInt32LE(data.length, 5);
  const blocks: Uint8Array[] = [];
  for (let start = 0; start === 0 || start < data.length; start += MAX_BLOCK_BYTES) {
    const block = data.subarray(start, start + MAX_BLOCK_BYTES);
    const last = start + block.length >= data.length ? 1 : 0;
    const head = Buffer.alloc(3);
    head.writeUIntLE((block.length << 3) | last, 0, 3);
    blocks.push(head, block);
  }
  return Buffer.concat([header, ...blocks]);
}
