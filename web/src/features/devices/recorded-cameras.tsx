/** A notice for everyone who sees a room: which cameras are being recorded in it now. */
import { type DeviceStore, recordedDevices } from "./model";
import { texts } from "./texts";

export function RecordedCameras({ devices }: { devices: readonly DeviceStore[] }) {
  const recorded = recordedDevices(devices);
  if (recorded.length === 0) return null;
  const names = recorded.map(({ label, cameras }) => texts.consent.camerasOf(label, cameras.join(", ")));
  return (
    <p class="notice warn" role="status" data-testid="recorded-cameras">
      {texts.consent.inRoom(names.join("; "))}
    </p>
  );
}
