/** Why control was lost, whether it is available, and what this account is running. */
import { ended } from "../../actions/model";
import type { DeviceStore } from "../../devices/model";
import type { DeviceSession } from "./device-session";

const LEASE_ENDED = "lease-ended";

export interface ReportedEnd {
  /** A reason code of the robot, such as "stopped" or "fault". */
  code: string;
  message: string;
}

/** The robot's reason for the end of a lease; `null`: not reported yet. The report follows telemetry by about 100 ms. */
export function reportedEnd(device: DeviceStore, epoch: number): ReportedEnd | null {
  const event = device.events.value.find(({ kind, data }) => kind === LEASE_ENDED && data["epoch"] === epoch);
  if (event === undefined) return null;
  // The event names the holder first: "Ann's control ended: stopped by Bob".
  const code = event.data["code"];
  return { code: typeof code === "string" ? code : "", message: event.message.replace(/^.*? control ended: /, "") };
}

/** Whether a device without an operator can be moved once an operator takes control. */
export type Availability = "available" | "stop" | "fault" | "unknown";

/** See `Availability`. "unknown": its state is not current. */
export function availability(device: DeviceStore): Availability {
  if (device.stopped.value || device.stopPending.value || device.stopFaulty.value) return "stop";
  if (!device.live.value) return "unknown";
  return (device.mode.value ?? device.state.value?.mode) === "fault" ? "fault" : "available";
}

/** The action that this account is running; `elsewhere`: from another sign-in session. `null`: none. */
export function ownAction({ device, actions, account }: DeviceSession): { name: string; elsewhere: boolean } | null {
  const runs = actions.runs.value;
  const own = runs.find(({ status }) => status === "accepted" || status === "started");
  if (own !== undefined) return { name: nameOf(own.request), elsewhere: false };
  const reported = device.live.value ? (device.state.value?.action ?? null) : null;
  const holder = device.holder.value;
  // The robot's state is up to a second old: it may still contain a run that has ended.
  if (reported === null || holder === null || runs.some((run) => run.id === reported.id && ended(run))) return null;
  return holder.mine || holder.account === account ? { name: nameOf(reported), elsewhere: !holder.mine } : null;
}

function nameOf(action: { kind: string; name?: string }): string {
  return action.name === undefined || action.name === "" ? action.kind.replaceAll("_", " ") : action.name;
}
