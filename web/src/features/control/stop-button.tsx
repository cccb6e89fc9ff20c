import { type DeviceStore, newestFault } from "../devices/model";
import { useState } from "preact/hooks";
import type { StopSwitch } from "./model/stop";
import { texts } from "./texts";

interface StopBannerProps {
  device: DeviceStore;
  stop: StopSwitch;
}

/** The state of Stop. The live region always exists, so that screen readers announce changes. */
export function StopBanner({ device, stop }: StopBannerProps) {
  const state = stop.state.value;
  const error = stop.error.value;
  return (
    <div role="alert" class="alert-slot">
      {state.kind !== "clear" && (
        <div class="banner stopped" data-testid="stop-banner" data-state={state.kind}>
          {state.kind === "latched" ? (
            <Latched device={device} stop={stop} />
          ) : (
            <div>
              <strong>{texts.stop.outcomes[state.kind]}</strong>
              {state.kind === "fault" && <p>{texts.stop.faulty(newestFault(device))} {texts.stop.go}</p>}
              {(state.kind === "sent" || state.kind === "unreachable") && (
                <p>{state.repeating ? texts.stop.repeating : `${texts.stop.ended} ${texts.stop.go}`}</p>
              )}
            </div>
          )}
          {error !== null && <p>{error}</p>}
        </div>
      )}
      {state.kind === "clear" && error !== null && <p class="notice bad">{error}</p>}
    </div>
  );
}

/** The outcome for each stopped robot, below a button that stops several. */
export function StopOutcomes({ sessions }: { sessions: readonly { device: DeviceStore; stop: StopSwitch }[] }) {
  const stopped = sessions.filter(({ stop }) => stop.state.value.kind !== "clear");
  return (
    <ul class="stop-outcomes" role="status" data-testid="stop-outcomes">
      {stopped.map(({ device, stop }) => (
        <li key={device.id} data-device={device.id} data-state={stop.state.value.kind}>
          <strong>{device.info.value.label}</strong>: {texts.stop.outcomes[stop.state.value.kind]}
        </li>
      ))}
    </ul>
  );
}

function Latched({ device, stop }: StopBannerProps) {
  const [confirming, setConfirming] = useState(false);
  const latch = device.state.value?.stop;
  const resetting = stop.resetting.value;
  return (
    <>
      <div>
        <strong class="big">{texts.stop.outcomes.latched}</strong>{" "}
        {latch !== undefined && latch !== null && texts.stop.by(latch.caller, latch.reason)}
        <p>{texts.stop.explain}</p>
      </div>
      {confirming ? (
        <div class="row" role="group" aria-label={texts.stop.confirmQuestion}>
          <span>{texts.stop.confirmQuestion}</span>
          <button
            type="button"
            data-testid="confirm-reset"
            disabled={resetting}
            onClick={() => void stop.reset().then(() => setConfirming(false))}
          >
            {resetting ? texts.stop.resetting : texts.stop.confirm}
          </button>
          <button type="button" data-testid="keep-stopped" disabled={resetting} onClick={() => setConfirming(false)}>
            {texts.stop.keep}
          </button>
        </div>
      ) : (
        <button type="button" data-testid="reset-stop" onClick={() => setConfirming(true)}>
          {texts.stop.reset}
        </button>
      )}
    </>
  );
}
