/** Which of its faults a device shows first. */
import type { DeviceStore } from "./device-store";

/** The message of the fault that was present last; empty: none. */
export function newestFault(device: DeviceStore): string {
  const faults = device.state.value?.faults ?? [];
  return [...faults].sort((one, other) => (other.last_ms ?? 0) - (one.last_ms ?? 0))[0]?.message ?? "";
}

/** The message of the fault that holds a device; null: none does, because it operates in spite of its other faults. */
export function holdingFault(device: DeviceStore): string | null {
  return device.state.value?.mode === "fault" ? newestFault(device) : null;
}
