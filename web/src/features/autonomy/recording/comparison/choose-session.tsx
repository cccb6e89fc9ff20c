/** Chooses the session to compare with: a robot of the same type, and one of its recorded sessions. */
import { useEffect, useMemo, useState } from "preact/hooks";
import type { Api } from "../../../../shared/api/client";
import { common } from "../../../../shared/i18n/common";
import { format } from "../../../../shared/i18n/format";
import type { DeviceStore, Fleet } from "../../../devices/model";
import { SessionHistory } from "../../model";
import { texts as sessionTexts } from "../texts";
import { texts } from "./texts";

interface ChooseSessionProps {
  api: Api;
  fleet: Fleet;
  device: DeviceStore;
  /** The shown session, which is not offered. */
  epoch: number;
  onChoose: (device: string, epoch: number) => void;
}

export function ChooseSession({ api, fleet, device, epoch, onChoose }: ChooseSessionProps) {
  const [robot, setRobot] = useState(device.id);
  const history = useMemo(() => new SessionHistory(api, robot), [api, robot]);
  useEffect(() => void history.refresh(), [history]);
  const type = device.info.value.robot_type;
  const robots = [...(fleet.devices.value?.values() ?? [])].filter(({ info }) => info.value.robot_type === type);
  const sessions = (history.sessions.value ?? []).filter((one) => one.recorded && (robot !== device.id || one.epoch !== epoch));
  const error = history.error.value;
  return (
    <div class="row session-choose">
      <label>
        {texts.robot}
        <select data-testid="compare-robot" value={robot} onChange={(event) => setRobot(event.currentTarget.value)}>
          {robots.map(({ id, info }) => (
            <option key={id} value={id}>
              {info.value.label}
            </option>
          ))}
        </select>
      </label>
      <label>
        {texts.session}
        <select data-testid="compare-session" value="" disabled={sessions.length === 0} onChange={(event) => onChoose(robot, Number(event.currentTarget.value))}>
          <option value="" disabled>
            {texts.choose}
          </option>
          {sessions.map((one) => (
            <option key={one.epoch} value={String(one.epoch)}>
              {texts.item(one.holder ?? texts.unknown, one.started_at === null ? format.unknown : format.dateTime(one.started_at), one.task ?? sessionTexts.manual)}
            </option>
          ))}
        </select>
      </label>
      {history.more.value && (
        <button type="button" class="plain" disabled={history.busy.value} onClick={() => void history.loadOlder()}>
          {texts.older}
        </button>
      )}
      {error !== "" && (
        <span class="bad" role="alert">
          {common.loadFailed(error)}
        </span>
      )}
      {history.sessions.value !== null && sessions.length === 0 && <span class="quiet small">{texts.noSessions}</span>}
    </div>
  );
}
