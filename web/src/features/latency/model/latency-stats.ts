/** Latency statistics from the stored samples of operators, agents and the cloud. */
import type { Path, Sample, StoredLatency, Transport } from "../../../shared/api/latency";
import { percentile } from "./round-trip";

/** One line of a plot: one device, transport and path. */
export interface Line {
  device: string;
  transport: Transport;
  path: Path;
  /** In order of time. */
  samples: readonly Sample[];
  /** Samples that the cloud has counted in the time span; old ones are only part of its statistics. */
  stored: number;
}

interface LatencyQuery {
  /** `null`: all. */
  device: string | null;
  transport: Transport | null;
  path: Path | null;
  /** Start of the time span [ms since 1970]. */
  sinceMs: number;
}

export function lineKey({ device, transport, path }: Pick<Line, "device" | "transport" | "path">): string {
  return `${device} ${transport} ${path}`;
}

/** Joins stored samples and this page's unsaved ones (`unsaved`); each sample counts once. */
export function linesOf(stored: ReadonlyMap<string, readonly StoredLatency[]>, unsaved: readonly Line[], query: LatencyQuery): Line[] {
  const lines = new Map<string, Line>();
  for (const [device, items] of stored) {
    for (const { transport, path, at_ms, ms, count } of items) {
      const samples = at_ms.map((atMs, index): Sample => ({ atMs, ms: ms[index] ?? 0 }));
      lines.set(lineKey({ device, transport, path }), { device, transport, path, samples, stored: count });
    }
  }
  for (const line of unsaved) {
    const existing = lines.get(lineKey(line));
    const seen = new Set(existing?.samples.map(({ atMs, ms }) => `${atMs} ${ms}`));
    const more = line.samples.filter(({ atMs, ms }) => !seen.has(`${atMs} ${ms}`));
    const samples = [...(existing?.samples ?? []), ...more].sort((one, other) => one.atMs - other.atMs);
    lines.set(lineKey(line), { ...line, samples, stored: existing?.stored ?? 0 });
  }
  return [...lines.values()]
    .filter((line) => [null, line.device].includes(query.device) && [null, line.transport].includes(query.transport))
    .filter((line) => query.path === null || line.path === query.path)
    .map((line) => ({ ...line, samples: line.samples.filter(({ atMs }) => atMs >= query.sinceMs) }))
    .filter(({ samples }) => samples.length > 0)
    .sort((one, other) => lineKey(one).localeCompare(lineKey(other)));
}

interface Figures {
  count: number;
  meanMs: number;
  medianMs: number;
  p95Ms: number;
  p99Ms: number;
  maxMs: number;
}

/** Statistics of at least one sample. */
export function figuresOf(samples: readonly Sample[]): Figures {
  const sorted = samples.map(({ ms }) => ms).sort((one, other) => one - other);
  return {
    count: sorted.length,
    meanMs: sorted.reduce((sum, ms) => sum + ms, 0) / sorted.length,
    medianMs: percentile(sorted, 0.5),
    p95Ms: percentile(sorted, 0.95),
    p99Ms: percentile(sorted, 0.99),
    maxMs: sorted.at(-1) ?? NaN,
  };
}

/** For each time, the share of samples up to it, 0…1. */
export function distribution(samples: readonly Sample[]): [ms: number[], share: number[]] {
  const sorted = samples.map(({ ms }) => ms).sort((one, other) => one - other);
  const ends = [...new Set(sorted)];
  return [ends, ends.map((ms) => (sorted.findLastIndex((one) => one <= ms) + 1) / sorted.length)];
}

/** CSV export of the displayed samples: a header row, then one row per sample. */
export function csv(lines: readonly Line[], label: (device: string) => string): string {
  const rows = lines.flatMap((line) =>
    line.samples.map(({ atMs, ms }) => [line.device, label(line.device), line.transport, line.path, new Date(atMs).toISOString(), String(ms)]),
  );
  return [["device", "label", "transport", "path", "at", "ms"], ...rows].map((row) => row.map(cell).join(",") + "\r\n").join("");
}

/** Quotes a field as in RFC 4180; text that a spreadsheet would read as a formula is escaped. */
function cell(text: string): string {
  const safe = /^[=+\-@\t]/.test(text) ? `'${text}` : text;
  return /[",\r\n']/.test(safe) ? `"${safe.replaceAll('"', '""')}"` : safe;
}
