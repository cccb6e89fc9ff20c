/** Reads MCAP segments. Same format as device_agent/runtime/recording/format.py. */
import { McapStreamReader, type McapTypes } from "@mcap/core";
import { decompress } from "fzstd";
import { ApiError } from "../../../../shared/api/http";
import { type KnownEvent, readEvent } from "../../../../shared/mqtt/parse-messages";
import { codes, FileError, flat } from "./overview";
import type { FileParts } from "./remote-file";
import { MODES, SOURCES } from "./samples";
import { buffersOf, type Images, type Segment, type TimedEvent } from "./segment";

const CONTROL = "/control";
const EVENTS = "/events";
const FRAMES = "/frames/";
/** Name of the metadata record, and its fields that are used here. Each value is JSON. */
const METADATA = "telescope";
/** A segment has one minute; larger chunks are damaged [bytes]. */
const MAX_CHUNK_BYTES = 1 << 29;

interface ControlRow {
  sequence: number;
  mode: string;
  source: string;
  position_rad: number[];
  requested_rad: number[];
  commanded_rad: number[];
  applied_rad: number[];
  twist?: number[];
  setpoint_sequence?: number;
  seen_tick_ms?: number;
  loop_age_ms?: number;
  limited?: string[];
}

interface Message<T> {
  logNs: bigint;
  value: T;
}

interface Image {
  format: string;
  data: string;
}

interface Contents {
  info: ReadonlyMap<string, string>;
  rows: Message<ControlRow>[];
  events: Message<KnownEvent>[];
  images: Map<string, Message<Image>[]>;
}

/** Called often while decoding, so that a worker can receive messages. If it throws, decoding ends. */
type Pause = () => Promise<void>;

/** Messages between two pauses. */
const PAUSE_EVERY = 500;

/** The content of one segment. A truncated file has the rows before its end. Throws `FileError`. */
export function decodeSegment(file: Uint8Array, pause?: Pause): Promise<Segment> {
  return readable(async () => {
    const reader = readerOf(false);
    reader.append(file);
    const contents = await contentsOf(reader, pause);
    return columnsOf(contents, reader.done() ? "whole" : "truncated");
  });
}

/** The part of a segment around a time since the start of the session [s], without reading the rest. Null: not possible. */
export function decodeExcerpt(file: FileParts, at_s: number, pause?: Pause): Promise<Segment | null> {
  return readable(async () => {
    const index = await readIndex(file);
    if (index === null) return null;
    const atNs = BigInt(field(index.info, "started_ns")) + BigInt(Math.round(at_s * 1e9));
    const chunk = chunkAt(index.chunks, atNs);
    if (chunk === undefined) return null;
    const reader = readerOf(true);
    for (const part of [index.summary, index.metadata, await record(file, chunk.chunkStartOffset, chunk.chunkLength)]) reader.append(part);
    return columnsOf(await contentsOf(reader, pause), "excerpt");
  });
}

async function readable<T>(read: () => Promise<T>): Promise<T> {
  try {
    return await read();
  } catch (error) {
    // A failed download, and the end that a pause has requested, are not the file's fault.
    const other = error instanceof FileError || error instanceof ApiError || (error instanceof DOMException && error.name === "AbortError");
    throw other ? error : new FileError("The segment is damaged.");
  }
}

function columnsOf({ info, rows, events, images }: Contents, extent: Segment["extent"]): Segment {
  const startedNs = BigInt(field(info, "started_ns"));
  const seconds = (logNs: bigint): number => Number(logNs - startedNs) / 1e9;
  const joints = JSON.parse(field(info, "joints")) as string[];
  const column = (name: "position_rad" | "requested_rad" | "commanded_rad" | "applied_rad"): Float64Array =>
    flat(rows.map(({ value }) => value[name]), joints.length);
  const scalar = (of: (row: ControlRow) => number): Float64Array => Float64Array.from(rows, ({ value }) => of(value));
  const segment: Segment = {
    segment: Number(field(info, "segment")),
    epoch: Number(field(info, "epoch")),
    started_tick_ms: Number(field(info, "started_tick_ns")) / 1e6,
    period_s: Number(field(info, "period_ms")) / 1000,
    joints,
    time_s: Float64Array.from(rows, ({ logNs }) => seconds(logNs)),
    position_rad: column("position_rad"),
    requested_rad: column("requested_rad"),
    commanded_rad: column("commanded_rad"),
    applied_rad: column("applied_rad"),
    twist: flat(rows.map(({ value }) => value.twist ?? [0, 0, 0]), 3),
    source: codes(rows.map(({ value }) => value.source), SOURCES),
    mode: codes(rows.map(({ value }) => value.mode), MODES),
    sequence: scalar(({ sequence }) => sequence),
    setpoint_sequence: scalar((row) => row.setpoint_sequence ?? 0),
    seen_tick_ms: scalar((row) => row.seen_tick_ms ?? 0),
    loop_age_ms: scalar((row) => row.loop_age_ms ?? 0),
    limited: shared(rows.map(({ value }) => value.limited ?? [])),
    events: events.map(({ logNs, value }): TimedEvent => ({ time_s: seconds(logNs), event: value })),
    images: [...images].map(([topic, found]) => imagesOf(topic, found, seconds)),
    extent,
    bytes: 0,
  };
  return { ...segment, bytes: buffersOf(segment).reduce((sum, { byteLength }) => sum + byteLength, 0) };
}

function field(info: ReadonlyMap<string, string>, name: string): string {
  const found = info.get(name);
  if (found === undefined) throw new FileError("The file ends before its first row, or is damaged.");
  return found;
}

function readerOf(noMagicPrefix: boolean): McapStreamReader {
  return new McapStreamReader({ decompressHandlers: { zstd: unpacked }, validateCrcs: true, noMagicPrefix });
}

/** All messages in order of time. */
async function contentsOf(reader: McapStreamReader, pause: Pause = () => Promise.resolve()): Promise<Contents> {
  const contents: Contents = { info: new Map(), rows: [], events: [], images: new Map() };
  const topics = new Map<number, string>();
  let count = 0;
  for (let record = reader.nextRecord(); record !== undefined; record = reader.nextRecord()) {
    if (record.type === "Channel") topics.set(record.id, record.topic);
    else if (record.type === "Metadata" && record.name === METADATA) contents.info = record.metadata;
    else if (record.type === "Message") add(contents, topics.get(record.channelId) ?? "", record);
    count += 1;
    if (count % PAUSE_EVERY === 0) await pause();
  }
  for (const messages of [contents.rows, contents.events, ...contents.images.values()]) messages.sort(byTime);
  return contents;
}

interface Index {
  /** Records with schemas and channels. */
  summary: Uint8Array;
  metadata: Uint8Array;
  info: ReadonlyMap<string, string>;
  /** In order of time. */
  chunks: McapTypes.ChunkIndex[];
}

/** Bytes of the footer record, and of the magic after it. */
const FOOTER_BYTES = 29;
const MAGIC_BYTES = 8;
/** Place of the field `summary_start` in the footer record: after opcode and length. */
const SUMMARY_START = 9;
/** The index of a minute is rarely longer [bytes]. */
const TAIL_BYTES = 32 * 1024;
/** The metadata record follows the header of the file [bytes]. */
const HEAD_BYTES = 4096;

/** The index at the end of a file; null: it has none. */
async function readIndex(file: FileParts): Promise<Index | null> {
  const footer = file.length - MAGIC_BYTES - FOOTER_BYTES;
  if (footer < 0) return null;
  const from = Math.max(0, file.length - TAIL_BYTES);
  const [head, tail] = await Promise.all([file.read(0, Math.min(HEAD_BYTES, file.length)), file.read(from, file.length)]);
  const start = new DataView(tail.buffer, tail.byteOffset).getBigUint64(footer - from + SUMMARY_START, true);
  if (start === 0n || start >= BigInt(footer)) return null;
  const summary = Number(start) >= from ? tail.subarray(Number(start) - from, footer - from) : await file.read(Number(start), footer);
  const reader = readerOf(true);
  reader.append(summary);
  const chunks: McapTypes.ChunkIndex[] = [];
  let place: McapTypes.MetadataIndex | null = null;
  for (let found = reader.nextRecord(); found !== undefined; found = reader.nextRecord()) {
    if (found.type === "ChunkIndex") chunks.push(found);
    else if (found.type === "MetadataIndex" && found.name === METADATA) place = found;
  }
  if (place === null) return null;
  const end = Number(place.offset + place.length);
  const metadata = end <= head.length ? head.subarray(Number(place.offset), end) : await record(file, place.offset, place.length);
  reader.append(metadata);
  const found = reader.nextRecord();
  if (found?.type !== "Metadata") return null;
  chunks.sort((one, other) => (one.messageStartTime < other.messageStartTime ? -1 : 1));
  return { summary, metadata, info: found.metadata, chunks };
}

/** The chunk with the rows of a time. Chunks may overlap: a late message extends one, so the shortest one is used. */
function chunkAt(chunks: readonly McapTypes.ChunkIndex[], atNs: bigint): McapTypes.ChunkIndex | undefined {
  const length = ({ messageStartTime, messageEndTime }: McapTypes.ChunkIndex): number => Number(messageEndTime - messageStartTime);
  const covering = chunks.filter((one) => one.messageStartTime <= atNs && atNs <= one.messageEndTime);
  const [shortest] = covering.sort((one, other) => length(one) - length(other));
  return shortest ?? chunks.findLast(({ messageStartTime }) => messageStartTime <= atNs) ?? chunks[0];
}

function record(file: FileParts, offset: bigint, length: bigint): Promise<Uint8Array> {
  return file.read(Number(offset), Number(offset + length));
}

/** The same lists, with one object for equal ones: most rows have the same limits. */
function shared(lists: readonly string[][]): readonly string[][] {
  const known = new Map<string, string[]>();
  return lists.map((list) => {
    const key = list.join("\n");
    const found = known.get(key) ?? list;
    known.set(key, found);
    return found;
  });
}

function unpacked(chunk: Uint8Array, size: bigint): Uint8Array {
  if (size > MAX_CHUNK_BYTES) throw new FileError("The segment has a chunk that is too large.");
  return decompress(chunk, new Uint8Array(Number(size)));
}

function byTime(one: { logNs: bigint }, other: { logNs: bigint }): number {
  return one.logNs < other.logNs ? -1 : one.logNs > other.logNs ? 1 : 0;
}

function add(contents: Contents, topic: string, { logTime: logNs, data }: McapTypes.Message): void {
  if (topic === CONTROL) contents.rows.push({ logNs, value: parsed(data) as ControlRow });
  else if (topic === EVENTS) contents.events.push({ logNs, value: readEvent(data) });
  else if (topic.startsWith(FRAMES)) {
    const images = contents.images.get(topic) ?? [];
    contents.images.set(topic, images);
    images.push({ logNs, value: parsed(data) as Image });
  }
}

const decoder = new TextDecoder();

function parsed(data: Uint8Array): unknown {
  return JSON.parse(decoder.decode(data));
}

function imagesOf(topic: string, images: readonly Message<Image>[], seconds: (logNs: bigint) => number): Images {
  const contents = images.map(({ value }) => base64(value.data));
  const offsets = new Uint32Array(contents.length + 1);
  contents.forEach((content, index) => (offsets[index + 1] = (offsets[index] ?? 0) + content.length));
  const data = new Uint8Array(offsets.at(-1) ?? 0);
  contents.forEach((content, index) => data.set(content, offsets[index]));
  return {
    topic,
    time_s: Float64Array.from(images, ({ logNs }) => seconds(logNs)),
    types: images.map(({ value }) => `image/${value.format}`),
    offsets,
    data,
  };
}

function base64(text: string): Uint8Array {
  const binary = atob(text);
  const content = new Uint8Array(binary.length);
  for (let index = 0; index < binary.length; index += 1) content[index] = binary.charCodeAt(index);
  return content;
}
