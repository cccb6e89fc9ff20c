/** The keyframe editor of one device: the same for an arm, a humanoid, a base and a head. */
import { useEffect, useRef, useState } from "preact/hooks";
import type { Account, Api } from "../../core/api";
import type { DeviceStore } from "../../core/device";
import type { Fleet } from "../../core/fleet";
import { ApiError, sentence } from "../../core/http";
import { begun, Drafts, Editor } from "../../core/keyframe-editor";
import { readScript } from "../../core/keyframe-script";
import type { Movement } from "../../core/keyframes";
import type { Station } from "../../core/station";
import { texts } from "../../texts";
import { ControlBar } from "../control-bar";
import { ReachChip } from "../parts";
import { deviceAddress, fleetAddress, keyframesAddress } from "../route";
import { useStations } from "../stations";
import { StopBanner } from "../stop";
import { KeyframeCard } from "./keyframe-card";
import "./keyframes.css";
import { Record } from "./record";
import { Save } from "./save";
import { Problems, Timeline } from "./timeline";
import { measuredPose, Twin } from "./twin";

interface KeyframesPageProps {
  api: Api;
  fleet: Fleet;
  account: Account;
  id: string;
  /** Of the movement; empty: a new one. */
  name: string;
}

export function KeyframesPage({ api, fleet, account, id, name }: KeyframesPageProps) {
  const devices = fleet.devices.value;
  const device = devices?.get(id);
  if (device === undefined) {
    return (
      <main class="page" id="content">
        <p class="quiet">{devices === null ? texts.loading : texts.device.missing}</p>
        {devices !== null && <a href={fleetAddress}>{texts.device.back}</a>}
      </main>
    );
  }
  return <OfDevice key={id} api={api} fleet={fleet} account={account} device={device} name={name} />;
}

type Source =
  | { kind: "loading" }
  | { kind: "there"; saved: Movement | null; version: number }
  | { kind: "by-hand" }
  | { kind: "failed"; why: string };

interface OfDeviceProps {
  api: Api;
  fleet: Fleet;
  account: Account;
  device: DeviceStore;
  name: string;
}

function OfDevice({ api, fleet, account, device, name }: OfDeviceProps) {
  const [station] = useStations(api, fleet, [device], account);
  const [source, setSource] = useState<Source>(name === "" ? { kind: "there", saved: null, version: 0 } : { kind: "loading" });
  const [tries, setTries] = useState(0);
  const { robot_type: robotType, label } = device.info.value;
  useEffect(() => {
    if (name === "") return undefined;
    let wanted = true;
    void load(api, robotType, name).then((found) => wanted && setSource(found));
    return () => {
      wanted = false;
    };
  }, [api, robotType, name, tries]);
  if (station === undefined) return null;
  return (
    <>
      <ControlBar device={device} control={station.control} stop={station.stop} />
      <main class="page operate kf-page" id="content">
        <div class="heading">
          <a href={deviceAddress(device.id)}>← {label}</a>
          <h1>{texts.keyframes.title}</h1>
          <p class="quiet">
            {robotType.replaceAll("_", " ")}
            {name !== "" && ` · ${name}`}
          </p>
          <p class="reach">
            <ReachChip device={device} data-testid="online" />
          </p>
        </div>
        <StopBanner device={device} stop={station.stop} />
        {source.kind === "loading" && <p class="quiet">{texts.loading}</p>}
        {source.kind === "failed" && (
          <p class="notice bad" role="alert">
            {source.why}{" "}
            <button type="button" onClick={() => setTries(tries + 1)}>
              {texts.later.again}
            </button>
          </p>
        )}
        {source.kind === "by-hand" && (
          <p class="notice warn" role="alert" data-testid="kf-by-hand">
            {texts.keyframes.byHand(name)} <a href={`#/movements/${robotType}/${name}`}>{texts.keyframes.toCode}</a>
          </p>
        )}
        {source.kind === "there" && <Desk api={api} station={station} name={name} source={source} />}
      </main>
    </>
  );
}

async function load(api: Api, robotType: string, name: string): Promise<Source> {
  try {
    const found = await api.library.get(robotType, name);
    const read = readScript(found.source);
    if (read.kind !== "keyframes") return { kind: "by-hand" };
    return { kind: "there", saved: read.movement, version: found.built_in ? 0 : found.version };
  } catch (error) {
    // A movement of this name is yet to be made.
    if (error instanceof ApiError && error.status === 404) return { kind: "there", saved: null, version: 0 };
    return { kind: "failed", why: sentence(error) };
  }
}

interface DeskProps {
  api: Api;
  station: Station;
  name: string;
  source: Source & { kind: "there" };
}

const drafts = new Drafts(localStorage);

function Desk({ api, station, name: first, source }: DeskProps) {
  const { device } = station;
  const { robot_type: robotType } = device.info.value;
  const robot = device.description.value;
  const [name, setName] = useState(first);
  const [version, setVersion] = useState(source.version);
  const [editor, setEditor] = useState<Editor | null>(null);
  const draftOf = useRef(first);
  const [restored, setRestored] = useState(false);
  const [unkept, setUnkept] = useState(false);
  const measured = measuredPose(device);
  // A new movement begins where the robot is: its first word is waited for, where it is there to say one.
  const ready = robot !== null && (measured !== null || device.reach.value === "offline" || source.saved !== null);

  // Made once: what becomes of the robot later, or of the connection, must not touch what is being edited.
  useEffect(() => {
    if (!ready || editor !== null) return;
    const draft = drafts.read(robotType, first);
    setRestored(draft !== null && JSON.stringify(draft) !== JSON.stringify(source.saved));
    const from = { saved: source.saved, draft, fresh: begun(robot, measured) };
    setEditor(new Editor(robot, from, (movement) => setUnkept(!drafts.keep(robotType, draftOf.current, movement))));
  }, [ready, editor]);
  useEffect(() => () => editor?.dispose(), [editor]);
  useKeys(editor);

  if (editor === null) return <p class="quiet">{texts.keyframes.waiting}</p>;
  const onSaved = (saved: string, at: number): void => {
    draftOf.current = saved;
    setName(saved);
    setVersion(at);
    setRestored(false);
    // The address of what it is now; the page stays as it is.
    history.replaceState(null, "", keyframesAddress(device.id, saved));
  };
  return (
    <>
      {restored && (
        <p class="notice warn kf-restored" role="status" data-testid="kf-restored">
          {texts.keyframes.restored}{" "}
          <button
            type="button"
            onClick={() => {
              if (source.saved === null) editor.change(begun(editor.robot, measured));
              else editor.revert();
              setRestored(false);
            }}
          >
            {source.saved === null ? texts.keyframes.beginAnew : texts.keyframes.revert}
          </button>
        </p>
      )}
      {unkept && <p class="notice warn">{texts.keyframes.unkept}</p>}
      <div class="desk kf-desk">
        <div class="column">
          <Twin device={device} editor={editor} />
          <Timeline editor={editor} measured={measured} />
          <Record device={device} editor={editor} />
        </div>
        <div class="column">
          <Save api={api} station={station} editor={editor} robotType={robotType} name={name} version={version} onSaved={onSaved} />
          <Problems editor={editor} />
          <KeyframeCard editor={editor} measured={measured} />
        </div>
      </div>
    </>
  );
}

/** Undo and redo by keys, but not in a field of text, which has its own. */
function useKeys(editor: Editor | null): void {
  useEffect(() => {
    if (editor === null) return undefined;
    const press = (event: KeyboardEvent): void => {
      const typing = event.target instanceof HTMLInputElement && event.target.type === "text";
      if (typing || !(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== "z") return;
      event.preventDefault();
      if (event.shiftKey) editor.redo();
      else editor.undo();
    };
    addEventListener("keydown", press);
    return () => removeEventListener("keydown", press);
  }, [editor]);
}
