/** Filters a device list by text, by device kind and by "needs attention". */
import type { Device } from "../../../shared/api/types";
import type { DeviceStore } from "./device-store";

export type KindFilter = "all" | "robots" | "sensors";
export type OwnerFilter = "all" | "mine" | "shared";

export interface DeviceFilter {
  /** Words that must all occur in the label, name, type, kind or space. */
  search: string;
  kinds: KindFilter;
  owner: OwnerFilter;
  needsAttention: boolean;
}

/** For a room device, type and kind are equal. */
export function isRoomDevice({ kind, robot_type: type }: Pick<Device, "kind" | "robot_type">): boolean {
  return kind === type;
}

/** `faults`: number of faults from the device or the cloud. */
export function matchesFilter(device: DeviceStore, space: string, faults: number, filter: DeviceFilter): boolean {
  const { search, kinds, owner, needsAttention } = filter;
  const info = device.info.value;
  if (owner !== "all" && (info.role === "owner") !== (owner === "mine")) return false;
  if (kinds !== "all" && isRoomDevice(info) !== (kinds === "sensors")) return false;
  if (needsAttention && faults === 0 && !needsAttentionNow(device)) return false;
  const text = [info.label, info.name, info.kind, info.robot_type, space].join(" ").toLowerCase().replaceAll("_", " ");
  return search.toLowerCase().split(/\s+/).every((word) => text.includes(word));
}

function needsAttentionNow(device: DeviceStore): boolean {
  return device.reach.value !== "online" || device.stopped.value || device.state.value?.mode === "fault";
}
