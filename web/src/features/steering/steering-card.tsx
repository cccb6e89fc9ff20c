/** What moves a robot by hand, in the ways that its description names: joints, a frame, the base. */
import type { DeviceSession } from "../devices/model";
import { Card } from "../../shared/ui/card";
import { useId, useRef, useState } from "preact/hooks";
import type { ComponentType } from "preact";
import { steeringModesOf, type SteeringMode } from "./model/steerable-parts";
import { texts } from "./texts";
import { BlockedNotice, blockedReason } from "./blocked-notice";
import { DrivePanel } from "./drive-panel";
import { useGamepad, type PadNews } from "./inputs/use-gamepad";
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

interface SteerCardProps {
  session: DeviceSession;
  /** Whether keys and gamepad are this robot's: of several, one. */
  active?: boolean;
  /** What the gamepad's button for it stops. */
  onStop: () => void;
}

export function SteeringCard({ session, active = true, onStop }: SteerCardProps) {
  const { device, control } = session;
  const ways = steeringModesOf(device.description.value);
  const [picked, setPicked] = useState<SteeringMode>("joints");
  const [keysShown, setKeysShown] = useState(false);
  const id = useId();
  const way = ways.includes(picked) ? picked : (ways[0] ?? "joints");
  const blocked = blockedReason(device, control);
  const streamer = blocked === null ? control.streamer.value : null;
  const pad = useGamepad(active, onStop);
  useKey(active, (event) => {
    if (event.repeat) return false;
    if (event.key === "?") setKeysShown(!keysShown);
    else if (event.code === "KeyT") takeOrRelease(session);
    else return false;
    return true;
  });
  const Panel = PANELS[way];
  return (
    <Card
      title={ways.length > 1 ? texts.steer.title : texts.joints.title}
      class="joints steer"
      data-testid="steer-card"
      aside={<BlockedNotice device={device} streamer={control.streamer.value} blocked={blocked} />}
    >
      <div class="steer-top">
        {ways.length > 1 && <Tabs ways={ways} way={way} id={id} onChange={setPicked} />}
        <button
          type="button"
          class="plain"
          data-testid="show-keys"
          aria-expanded={keysShown}
          onClick={() => setKeysShown(!keysShown)}
        >
          {texts.steer.showKeys} <kbd>?</kbd>
        </button>
      </div>
      <p class="pad-news small quiet" role="status" data-testid="gamepad">
        {news(pad.news.value)}
      </p>
      {keysShown && <KeyboardHelp way={way} />}
      <div
        {...(ways.length > 1 ? { role: "tabpanel", id: `${id}-panel`, "aria-labelledby": `${id}-${way}` } : {})}
        class="steer-panel"
        data-testid={`steer-${way}`}
      >
        <Panel device={device} streamer={streamer} active={active} pad={pad} />
      </div>
    </Card>
  );
}

/** As the button does it, and where it would. */
function takeOrRelease({ device, control }: DeviceSession): void {
  if (control.streamer.value !== null) void control.release();
  else if (device.description.value !== null && device.info.value.role !== "viewer") void control.take();
}

function news(what: PadNews | null): string {
  return what === null ? "" : texts.steer.pads[what.kind](what.id);
}

interface TabsProps {
  ways: readonly SteeringMode[];
  way: SteeringMode;
  id: string;
  onChange: (way: SteeringMode) => void;
}

function Tabs({ ways, way, id, onChange }: TabsProps) {
  const list = useRef<HTMLDivElement>(null);
  const go = (step: number): void => {
    const next = ways[(ways.indexOf(way) + step + ways.length) % ways.length];
    if (next === undefined) return;
    onChange(next);
    list.current?.querySelector<HTMLElement>(`#${CSS.escape(`${id}-${next}`)}`)?.focus();
  };
  return (
    <div
      ref={list}
      class="tabs"
      role="tablist"
      aria-label={texts.steer.ways}
      onKeyDown={(event) => {
        if (event.key === "ArrowRight") go(1);
        else if (event.key === "ArrowLeft") go(-1);
        else return;
        event.preventDefault();
      }}
    >
      {ways.map((each) => (
        <button
          key={each}
          type="button"
          role="tab"
          id={`${id}-${each}`}
          data-testid={`tab-${each}`}
          aria-selected={each === way}
          aria-controls={`${id}-panel`}
          tabIndex={each === way ? 0 : -1}
          onClick={() => onChange(each)}
        >
          {texts.steer.way[each]}
        </button>
      ))}
    </div>
  );
}
