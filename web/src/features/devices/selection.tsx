/** Selection of robots in the device list, to operate them on one page. */
import type { DeviceStore } from "./model";
import { signal } from "@preact/signals";
import { texts } from "./texts";
import { multiRobotAddress } from "../../shared/routing/routes";

const selectedIds = signal<readonly string[]>([]);

export function MultiRobotCheckbox({ device }: { device: DeviceStore }) {
  const { id } = device;
  return (
    <input
      type="checkbox"
      class="pick"
      data-testid="pick"
      aria-label={texts.selection.add(device.info.value.label)}
      checked={selectedIds.value.includes(id)}
      onChange={(event) => {
        const others = selectedIds.value.filter((each) => each !== id);
        selectedIds.value = event.currentTarget.checked ? [...others, id] : others;
      }}
    />
  );
}

/** `devices`: all devices. Selected devices that no longer exist are ignored. */
export function OperateSelected({ devices }: { devices: readonly DeviceStore[] }) {
  const ids = selectedIds.value.filter((id) => devices.some((device) => device.id === id));
  return (
    <div role="status">
      {ids.length > 0 && (
        <p class="row together-offer">
          {texts.selection.count(ids.length)}
          {ids.length > 1 && (
            <a class="elsewhere" href={multiRobotAddress(ids)} data-testid="operate-together">
              {texts.selection.open}
            </a>
          )}
          <button type="button" class="plain" onClick={() => (selectedIds.value = [])}>
            {texts.selection.clear}
          </button>
        </p>
      )}
    </div>
  );
}
