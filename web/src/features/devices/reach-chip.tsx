import { useComputed } from "@preact/signals";
import { common } from "../../shared/i18n/common";
import { format } from "../../shared/i18n/format";
import { clock } from "../../shared/lib/clock";
import type { DeviceStore } from "./model/device-store";
import { texts } from "./texts";

/** Online, stale, offline or unknown, with the age of the device's last message. */
export function ReachChip({ device, ...rest }: { device: DeviceStore; "data-testid"?: string }) {
  const reach = device.reach.value;
  return (
    <span class={`chip reach-${reach}`} data-status={reach} title={device.info.value.incompatible ?? texts.reachExplained[reach]} {...rest}>
      <span class="dot" aria-hidden="true" />
      {texts.reach[reach]}
    </span>
  );
}

/** The age of the device's last message, updated every second. */
export function LastSeenAge({ device }: { device: DeviceStore }) {
  // A signal in the text, so that with 200 devices only the changed words are updated.
  const text = useComputed(() => {
    const heardAt = device.lastSeenAt.value;
    return heardAt === null ? common.never : format.age(Math.max(0, clock.value - heardAt));
  });
  return <>{text}</>;
}
