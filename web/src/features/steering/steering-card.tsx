/** Manual steering of a robot in the modes that its description supports: joints, a frame, the base. */
import type { DeviceSession } from "../control/model";
import { Card } from "../../shared/ui/card";
import { useId, useRef, useState } from "preact/hooks";
import type { ComponentType } from "preact";
import { steeringModesOf, type SteeringMode } from "./model/steerable-parts";
import { texts } from "./texts";
import { BlockedNotice, blockedReason } from "./blocked-notice";
import { DrivePanel } from "./drive-panel";
import { useGamepad, type GamepadNotice } from "./inputs/use-gamepad";
import { CartesianPanel } from "./cartesian-panel";
import { JointsPanel } from "./joints-panel";
import { KeyboardHelp, useKey } from "./inputs/keyboard-help";
import type { PanelProps } from "./panel-props";
import "./steering.css";

const PANELS: Readonly<Record<SteeringMode, ComponentType<PanelProps>>> = {
  joints: JointsPanel,
  jog: CartesianPanel,
  drive: DrivePanel,
};

interface SteeringCardProps {
  session: DeviceSession;
  /** Whether keyboard and gamepad control this robot. On a page with several robots only one is active. */
  active?: boolean;
  /** Called for the gamepad's Stop button. */
  onStop: () => void;
}

export function SteeringCard({ session, active = true, onStop }: SteeringCardProps) {
  const { device, control } = session;
  const modes = steeringModesOf(device.description.value);
  const [picked, setPicked] = useState<SteeringMode>("joints");
  const [helpShown, setHelpShown] = useState(false);
  const id = useId();
  const mode = modes.includes(picked) ? picked : (modes[0] ?? "joints");
  const blocked = blockedReason(device, control);
  const streamer = blocked === null ? control.streamer.value : null;
  const pad = useGamepad(active, onStop);
  useKey(active, (event) => {
    if (event.repeat) return false;
    if (event.key === "?") setHelpShown(!helpShown);
    else if (event.code === "KeyT") takeOrRelease(session);
    else return false;
    return true;
  });
  const Panel = PANELS[mode];
  return (
    <Card
      title={modes.length > 1 ? texts.steer.title : texts.joints.title}
      class="joints steer"
      data-testid="steer-card"
      aside={<BlockedNotice device={device} streamer={control.streamer.value} blocked={blocked} />}
    >
      <div class="steer-top">
        {modes.length > 1 && <Tabs modes={modes} mode={mode} id={id} onChange={setPicked} />}
        <button
          type="button"
          class="plain"
          data-testid="show-keys"
          aria-expanded={helpShown}
          onClick={() => setHelpShown(!helpShown)}
        >
          {texts.steer.showKeys} <kbd>?</kbd>
        </button>
      </div>
      <p class="pad-news small quiet" role="status" data-testid="gamepad">
        {noticeText(pad.notice.value)}
      </p>
      {helpShown && <KeyboardHelp mode={mode} />}
      <div
        {...(modes.length > 1 ? { role: "tabpanel", id: `${id}-panel`, "aria-labelledby": `${id}-${mode}` } : {})}
        class="steer-panel"
        data-testid={`steer-${mode}`}
      >
        <Panel device={device} streamer={streamer} active={active} pad={pad} />
      </div>
    </Card>
  );
}

/** Takes or releases control, under the same conditions as the button. */
function takeOrRelease({ device, control }: DeviceSession): void {
  if (control.streamer.value !== null) void control.release();
  else if (device.description.value !== null && device.info.value.role !== "viewer") void control.take();
}

function noticeText(what: GamepadNotice | null): string {
  return what === null ? "" : texts.steer.pads[what.kind](what.id);
}

interface TabsProps {
  modes: readonly SteeringMode[];
  mode: SteeringMode;
  id: string;
  onChange: (mode: SteeringMode) => void;
}

function Tabs({ modes, mode, id, onChange }: TabsProps) {
  const list = useRef<HTMLDivElement>(null);
  const selectTab = (step: number): void => {
    const next = modes[(modes.indexOf(mode) + step + modes.length) % modes.length];
    if (next === undefined) return;
    onChange(next);
    list.current?.querySelector<HTMLElement>(`#${CSS.escape(`${id}-${next}`)}`)?.focus();
  };
  return (
    <div
      ref={list}
      class="tabs"
      role="tablist"
      aria-label={texts.steer.modes}
      onKeyDown={(event) => {
        if (event.key === "ArrowRight") selectTab(1);
        else if (event.key === "ArrowLeft") selectTab(-1);
        else return;
        event.preventDefault();
      }}
    >
      {modes.map((each) => (
        <button
          key={each}
          type="button"
          role="tab"
          id={`${id}-${each}`}
          data-testid={`tab-${each}`}
          aria-selected={each === mode}
          aria-controls={`${id}-panel`}
          tabIndex={each === mode ? 0 : -1}
          onClick={() => onChange(each)}
        >
          {texts.steer.mode[each]}
        </button>
      ))}
    </div>
  );
}
