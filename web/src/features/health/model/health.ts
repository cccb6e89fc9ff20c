/** Device health: monitored fields, and faults from the first report to the end. */
import type { DeviceStore, Reach } from "../../devices/model";
import { type Quantity, quantityOf } from "../../sensors/model";
import type { Fault, HealthState, MonitoredField } from "../../../shared/api/health";
import type { KnownDescription, KnownTelemetry } from "../../../shared/mqtt/parse-messages";
import type { Fault as ReportedFault } from "../../../shared/mqtt/protocol.generated";

/** A fault as stored in the cloud and as reported by the device; differences are shown. */
export interface Standing {
  /** `null`: only the device reports it. */
  stored: Fault | null;
  /** `null`: not reported by the device, or not a fault that devices report. */
  told: ReportedFault | null;
  /** `unstored`, `ended`: only one of them knows it yet. `unheard`: the device is unreachable. */
  agreement: "same" | "unstored" | "ended" | "unheard";
}

/** Open faults of the cloud and the device, worst first. `told`: the device's faults; `null` if it is unreachable. */
export function standings(open: readonly Fault[], told: readonly ReportedFault[] | null): Standing[] {
  const left = new Map((told ?? []).map((fault) => [fault.code, fault]));
  const found = open.map((stored): Standing => {
    if (stored.source !== "device") return { stored, told: null, agreement: "same" };
    if (told === null) return { stored, told: null, agreement: "unheard" };
    const heard = left.get(stored.code) ?? null;
    left.delete(stored.code);
    return { stored, told: heard, agreement: heard === null ? "ended" : "same" };
  });
  return [...[...left.values()].map((one): Standing => ({ stored: null, told: one, agreement: "unstored" })), ...found];
}

/** The faults that the device reports now; `null` if it is unreachable. */
export function reportedFaults(device: DeviceStore): readonly ReportedFault[] | null {
  return device.live.value ? (device.state.value?.faults ?? null) : null;
}

/** Number of open faults: those the device reports now and those the cloud has detected. */
export function openCount(stored: readonly Pick<Fault, "source" | "code">[] | null, told: readonly ReportedFault[] | null): number {
  if (stored === null) return told?.length ?? 0;
  if (told === null) return stored.length;
  return stored.filter(({ source }) => source !== "device").length + told.length;
}

/** The worse of the cloud's result and the page's own observation. */
export function healthNow(stored: HealthState, told: readonly ReportedFault[] | null, reach: Reach): HealthState {
  if ((told?.length ?? 0) > 0) return "fault";
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
  const known = { controls: description?.controls ?? [], diagnostics: limited || listed ? [judged] : [] };
  const quantity = quantityOf(known, stream, field);
  if (!listed) return { ...quantity, judged: limited ? judged : null };
  return { ...quantity, label: [label, ...part.map(plain)].join(" · ") };
}

function plain(name: string): string {
  return name.replaceAll("_", " ");
}

interface Newest {
  /** On the agent's wall clock [ms since 1970]. */
  atMs: number;
  value: number | boolean;
}

const JOINTS = "joints";
const OF_JOINTS = ["position_rad", "velocity_rad_s", "effort_nm"] as const;
const LOOP_AGE = "loop_age_ms";

/** The newest value of a field from the device; `null` before the first. */
export function newestOf(device: DeviceStore, stream: string, field: string): Newest | null {
  const message = stream === JOINTS ? device.telemetry.value?.message : device.measured(stream).value?.message;
  if (message === undefined) return null;
  const value = "values" in message ? message.values[field] : ofJoints(device, message, field);
  return value === undefined ? null : { atMs: message.at_ms, value };
}

function ofJoints(device: DeviceStore, message: KnownTelemetry, field: string): number | undefined {
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
