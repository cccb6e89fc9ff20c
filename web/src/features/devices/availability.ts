/** Whether something may be asked of a device now, and if not, why. */
import type { Control } from "../control/model/lease";
import type { DeviceStore } from "./model/device-store";
import { texts } from "../../shared/i18n/texts";

/** Empty where it may. */
export function whyNot(device: DeviceStore): string {
  if (device.info.value.role === "viewer") return texts.room.watchOnly;
  if (device.reach.value === "offline" || device.reach.value === "unknown") return texts.room.away;
  if (device.stopped.value) return texts.room.stopFirst;
  return "";
}

/** The same of what only one can ask, and one thing at a time: of a robot. Empty where it may. */
export function whyNotAct(device: DeviceStore, control: Control): string {
  const no = whyNot(device);
  if (no !== "") return no;
  const mode = device.live.value ? device.mode.value : undefined;
  // First of all: an action that nobody had control for brings a lease of its own, and that says nothing here.
  if (mode === "action") return texts.acts.busy;
  const holder = device.holder.value;
  if (holder !== null && !holder.mine && control.epoch === null) return texts.acts.held(holder.name);
  if (mode === "fault") return texts.acts.fault;
  if (mode === "streaming" && control.streamer.value?.state.value !== "idle") return texts.acts.streaming;
  return "";
}
