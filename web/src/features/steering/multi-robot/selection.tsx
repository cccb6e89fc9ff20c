/** Which robots are ticked in the list, to be operated on one page. */
import type { DeviceStore } from "../../devices/model";
import { signal } from "@preact/signals";
import { texts } from "../texts";
import { multiRobotAddress } from "../../../shared/routing/routes";

const ticked = signal<readonly string[]>([]);

export function MultiRobotCheckbox({ device }: { device: DeviceStore }) {
  const { id } = device;
  return (
    <input
      type="checkbox"
      class="pick"
      data-testid="pick"
      aria-label={texts.multiRobot.pick(device.info.value.label)}
      checked={ticked.value.includes(id)}
      onChange={(event) => {
        const others = ticked.value.filter((each) => each !== id);
        ticked.value = event.currentTarget.checked ? [...others, id] : others;
      }}
    />
  );
}

/** `devices`: all that there are. What is ticked and has gone since does not count. */
export function OperateSelected({ devices }: { devices: readonly DeviceStore[] }) {
  const ids = ticked.value.filter((id) => devices.some((device) => device.id === id));
  return (
    <div role="status">
      {ids.length > 0 && (
        <p class="row together-offer">
          {texts.multiRobot.picked(ids.length)}
          {ids.length > 1 && (
            <a class="elsewhere" href={multiRobotAddress(ids)} data-testid="operate-together">
              {texts.multiRobot.open}
            </a>
          )}
          <button type="button" class="plain" onClick={() => (ticked.value = [])}>
            {texts.multiRobot.none}
          </button>
        </p>
      )}
    </div>
  );
}
