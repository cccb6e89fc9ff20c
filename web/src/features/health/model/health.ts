/** Device health: monitored fields, and faults from the first report to the end. */
import type { DeviceStore, Reach } from "../../devices/model";
import { type Quantity, quantityOf } from "../../sensors/model";
import type { Fault, HealthState, MonitoredField } from "../../../shared/api/health";
import type { KnownDescription, KnownTelemetry } from "../../../shared/mqtt/parse-messages";
import type { Fault as ReportedFault } from "../../../shared/mqtt/protocol.generated";

/** A fault as stored in the cloud and as reported by the device; differences are shown. */
export interface FaultComparison {
  /** `null`: only the device reports it. */
  stored: Fault | null;
  /** `null`: not reported by the device, or not a fault that devices report. */
  reported: ReportedFault | null;
  /** `unstored`: not stored yet. `ended`: no longer reported. `unreachable`: the device is unreachable. */
  agreement: "same" | "unstored" | "ended" | "unreachable";
}

/** Open faults of the cloud and the device, worst first. `reported`: the device's faults; `null` if it is unreachable. */
export function compareFaults(open: readonly Fault[], reported: readonly ReportedFault[] | null): FaultComparison[] {
  const remaining = new Map((reported ?? []).map((fault) => [fault.code, fault]));
  const stored = open.map((stored): FaultComparison => {
    if (stored.source !== "device") return { stored, reported: null, agreement: "same" };
    if (reported === null) return { stored, reported: null, agreement: "unreachable" };
    const match = remaining.get(stored.code) ?? null;
    remaining.delete(stored.code);
    return { stored, reported: match, agreement: match === null ? "ended" : "same" };
  });
  return [...[...remaining.values()].map((one): FaultComparison => ({ stored: null, reported: one, agreement: "unstored" })), ...stored];
}

/** The faults that the device reports now; `null` if it is unreachable. */
export function reportedFaults(device: DeviceStore): readonly ReportedFault[] | null {
  return device.live.value ? (device.state.value?.faults ?? null) : null;
}

/** Number of open faults: those the device reports now and those the cloud has detected. */
export function openCount(stored: readonly Pick<Fault, "source" | "code">[] | null, reported: readonly ReportedFault[] | null): number {
  if (stored === null) return reported?.length ?? 0;
  if (reported === null) return stored.length;
  return stored.filter(({ source }) => source !== "device").length + reported.length;
}

/** The worse of the cloud's result and the page's own observation. */
export function healthNow(stored: HealthState, reported: readonly ReportedFault[] | null, reach: Reach): HealthState {
  if ((reported?.length ?? 0) > 0) return "fault";
  if (stored === "ok" && (reach === "offline" || reach === "stale")) return "unknown";
  return stored;
}

/** Label, displayed unit and limits of a monitored field. */
export function watchedQuantity(watched: MonitoredField, description: KnownDescription | null): Quantity {
  const { stream, field, label, unit, advice, low, high, warning_low, warning_high } = watched;
  const [name = field, ...part] = field.split(".");
  const limited = [low, high, warning_low, warning_high].some((limit) => limit !== null);
  const listed = label !== name;
  const judged = { stream, fields: field, label, unit, advice, low, high, warning_low, warning_high, change: null, horizon_s: 0, checks: [] };
  const described = { controls: description?.controls ?? [], diagnostics: limited || listed ? [judged] : [] };
  const quantity = quantityOf(described, stream, field);
  if (!listed) return { ...quantity, limits: limited ? judged : null };
  return { ...quantity, label: [label, ...part.map(readable)].join(" · ") };
}

function readable(name: string): string {
  return name.replaceAll("_", " ");
}

interface TimedValue {
  /** On the agent's wall clock [ms since 1970]. */
  atMs: number;
  value: number | boolean;
}

const JOINTS = "joints";
const OF_JOINTS = ["position_rad", "velocity_rad_s", "effort_nm"] as const;
const LOOP_AGE = "loop_age_ms";

/** The newest value of a field from the device; `null` before the first. */
export function newestOf(device: DeviceStore, stream: string, field: string): TimedValue | null {
  const message = stream === JOINTS ? device.telemetry.value?.message : device.measured(stream).value?.message;
  if (message === undefined) return null;
  const value = "values" in message ? message.values[field] : jointValue(device, message, field);
  return value === undefined ? null : { atMs: message.at_ms, value };
}

function jointValue(device: DeviceStore, message: KnownTelemetry, field: string): number | undefined {
  if (field === LOOP_AGE) return message.mode === "streaming" ? message.loop_age_ms : undefined;
  const quantity = OF_JOINTS.find((one) => field.startsWith(`${one}.`));
  if (quantity === undefined) return undefined;
  const joint = device.description.value?.joints.findIndex(({ name }) => field === `${quantity}.${name}`) ?? -1;
  return message[quantity][joint];
}

/** Whether a stream is older than expected. */
export function isLate(device: DeviceStore, stream: string): boolean {
  return stream === JOINTS ? !device.live.value : device.late(stream);
}

/** Fields with findings first, otherwise in list order. */
export function worstFirst(fields: readonly MonitoredField[]): MonitoredField[] {
  return [...fields].sort((one, other) => other.findings.length - one.findings.length);
}

/** The time span around a fault [ms since 1970]. */
export function intervalAround(fault: Fault, marginMs = 60_000): [fromMs: number, toMs: number] {
  const end = fault.cleared_at === null ? Infinity : Date.parse(fault.cleared_at) + marginMs;
  return [Date.parse(fault.raised_at) - marginMs, end];
}
