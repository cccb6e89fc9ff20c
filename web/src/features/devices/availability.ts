/** Whether a device accepts actions now, and if not, why. */
import type { Control } from "../control/model";
import type { DeviceStore } from "./model/device-store";
import { texts } from "./texts";

/** Why the device is unavailable, or "". */
export function unavailableReason(device: DeviceStore): string {
  const reason = unreachableReason(device);
  return reason === "" && device.stopped.value ? texts.unavailable.stopped : reason;
}

function unreachableReason(device: DeviceStore): string {
  if (device.info.value.role === "viewer") return texts.unavailable.viewer;
  const { incompatible } = device.info.value;
  if (incompatible !== null) return incompatible;
  if (device.reach.value === "offline" || device.reach.value === "unknown") return texts.unavailable.offline;
  return "";
}

/** Why a recovery is unavailable, or "". It may be started while Stop is latched, and during a fault. */
export function recoveryUnavailableReason(device: DeviceStore, control: Control): string {
  const reason = unreachableReason(device);
  if (reason !== "") return reason;
  if (device.live.value && (device.state.value?.action ?? null) !== null) return texts.unavailable.busy;
  const holder = device.holder.value;
  if (holder !== null && !holder.mine && control.epoch === null) return texts.unavailable.held(holder.name);
  return "";
}

/** Why an exclusive action on a robot is unavailable, or "". */
export function actionUnavailableReason(device: DeviceStore, control: Control): string {
  const reason = unavailableReason(device);
  if (reason !== "") return reason;
  const mode = device.live.value ? device.mode.value : undefined;
  // Check this before the lease: an action without an operator has a lease of its own.
  if (mode === "action") return texts.unavailable.busy;
  const holder = device.holder.value;
  if (holder !== null && !holder.mine && control.epoch === null) return texts.unavailable.held(holder.name);
  if (mode === "fault") return texts.unavailable.fault;
  if (mode === "streaming" && control.streamer.value?.state.value !== "idle") return texts.unavailable.streaming;
  return "";
}
