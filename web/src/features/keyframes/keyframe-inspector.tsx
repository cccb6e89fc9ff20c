/** The selected keyframe: its time, joint positions and actions. */
import { supports } from "./model/problems";
import { JointSlider } from "../steering";
import { Card } from "../../shared/ui/card";
import { useState } from "preact/hooks";
import { clamp, degrees, radians } from "../../shared/lib/angles";
import type { Editor } from "./model/editor";
import { setAction, setPose, setPosition, setTime, type ActionKind, type ControlValue, type KeyframeActions, type Keyframe, type Positions } from "./model/keyframes";
import type { Control, Joint } from "../../shared/mqtt/protocol.generated";
import { texts } from "./texts";

interface KeyframeCardProps {
  editor: Editor;
  measured: Positions | null;
}

export function KeyframeInspector({ editor, measured }: KeyframeCardProps) {
  const index = editor.selected.value;
  const movement = editor.movement.value;
  const keyframe = movement.keyframes[index];
  if (keyframe === undefined) return null;
  return (
    <Card title={texts.number(index + 1)} class="kf-keyframe">
      <TimeFields key={index} editor={editor} index={index} keyframe={keyframe} />
      <button
        type="button"
        data-testid="kf-take-pose"
        disabled={measured === null}
        title={measured === null ? texts.notLive : undefined}
        onClick={() => measured !== null && editor.change(setPose(movement, index, measured, editor.robot))}
      >
        {texts.useCurrentPose}
      </button>
      <Joints editor={editor} index={index} keyframe={keyframe} measured={measured} />
      <ActionFields editor={editor} index={index} keyframe={keyframe} />
    </Card>
  );
}

interface PartProps {
  editor: Editor;
  index: number;
  keyframe: Keyframe;
}

function TimeFields({ editor, index, keyframe }: PartProps) {
  const [shifting, setShifting] = useState(true);
  const before = editor.movement.value.keyframes[index - 1];
  const set = (time: number): void => editor.change(setTime(editor.movement.value, index, time, shifting));
  if (before === undefined) return <p class="quiet small">{texts.first}</p>;
  return (
    <div class="row kf-times">
      <NumberField id="kf-time" label={texts.time} value={keyframe.time_s} digits={2} onSet={set} />
      <NumberField
        id="kf-interval"
        label={texts.interval}
        value={keyframe.time_s - before.time_s}
        digits={2}
        onSet={(interval_s) => set(before.time_s + interval_s)}
      />
      <label class="check">
        <input type="checkbox" checked={shifting} onChange={(event) => setShifting(event.currentTarget.checked)} />
        {texts.shifting}
      </label>
    </div>
  );
}

interface NumberFieldProps {
  id: string;
  label: string;
  value: number;
  digits: number;
  onSet: (value: number) => void;
}

/** A number field that applies its value on Enter or blur. */
function NumberField({ id, label, value, digits, onSet }: NumberFieldProps) {
  const [typed, setTyped] = useState<string | null>(null);
  const commit = (): void => {
    const value = Number(typed?.replace(",", "."));
    if (typed !== null && typed.trim() !== "" && Number.isFinite(value)) onSet(value);
    setTyped(null);
  };
  return (
    <span class="kf-number-field">
      <label for={id}>{label}</label>
      <input
        id={id}
        type="text"
        inputMode="decimal"
        data-testid={id}
        value={typed ?? value.toFixed(digits)}
        onInput={(event) => setTyped(event.currentTarget.value)}
        onBlur={commit}
        onKeyDown={(event) => {
          if (event.key === "Enter") commit();
        }}
      />
    </span>
  );
}

function Joints({ editor, index, keyframe, measured }: PartProps & { measured: Positions | null }) {
  const { robot } = editor;
  const followers = new Set(robot.mimic_joints.map(({ joint }) => joint));
  const pose = editor.poseAtKeyframe(index);
  const invalid = new Set(editor.problems.value.flatMap(({ keyframe: at, joint }) => (at === index && joint !== null ? [joint] : [])));
  return (
    <div class="kf-joints" role="group" aria-label={texts.joints} tabIndex={0} onPointerUp={() => editor.endGesture()}>
      {robot.joints
        .filter(({ name }) => !followers.has(name))
        .map((joint) => (
          <JointField
            key={joint.name}
            editor={editor}
            index={index}
            joint={joint}
            isSet={joint.name in keyframe.position_rad}
            target={keyframe.position_rad[joint.name] ?? pose[joint.name]}
            measured={measured?.[joint.name]}
            invalid={invalid.has(joint.name)}
          />
        ))}
    </div>
  );
}

interface JointFieldProps {
  editor: Editor;
  index: number;
  joint: Joint;
  /** Whether this keyframe sets the joint's position; otherwise it is interpolated. */
  isSet: boolean;
  target: number | undefined;
  measured: number | undefined;
  invalid: boolean;
}

function JointField({ editor, index, joint, isSet, target, measured, invalid }: JointFieldProps) {
  const set = (position: number | null): void =>
    editor.change(
      setPosition(editor.movement.value, index, joint, position, editor.robot),
      position === null ? "" : `${index}-${joint.name}`,
    );
  const start = (joint.lower_rad + joint.upper_rad) / 2;
  return (
    <div class={`kf-joint ${isSet ? "" : "interpolated"} ${invalid ? "invalid" : ""}`}>
      <JointSlider joint={joint} targetRad={target ?? start} measuredRad={measured} onSet={set} />
      <label class="check small quiet">
        <input
          type="checkbox"
          data-testid={`kf-set-${joint.name}`}
          aria-label={texts.positionSetFor(joint.label)}
          checked={isSet}
          onChange={(event) => set(event.currentTarget.checked ? (target ?? start) : null)}
        />
        {isSet ? texts.positionSet : texts.interpolated}
      </label>
    </div>
  );
}

/** Actions at the keyframe that the robot supports. */
function ActionFields({ editor, index, keyframe }: PartProps) {
  const { robot } = editor;
  const set = <D extends ActionKind>(action: D, value: KeyframeActions[D] | undefined): void =>
    editor.change(setAction(editor.movement.value, index, action, value), `${index}-${action}`);
  const named = [
    ["posture", robot.postures],
    ["behaviour", robot.behaviours],
    ["express", robot.expressions],
  ] as const;
  const { say, drive, go_to: goal, set_control: setting } = keyframe;
  if (!Object.keys(texts.actions).some((action) => supports(robot, action as ActionKind))) return null;
  return (
    <fieldset class="kf-keyframe-actions" onFocusOut={() => editor.endGesture()}>
      <legend>{texts.actionsTitle}</legend>
      <p class="quiet small">{texts.actionsNote}</p>
      {named.map(
        ([action, names]) =>
          supports(robot, action) && (
            <div class="field" key={action}>
              <label for={`kf-${action}`}>{texts.actions[action]}</label>
              <select
                id={`kf-${action}`}
                data-testid={`kf-${action}`}
                value={keyframe[action] ?? ""}
                onChange={(event) => set(action, event.currentTarget.value === "" ? undefined : event.currentTarget.value)}
              >
                <option value="">{texts.none}</option>
                {names.map((name) => (
                  <option key={name}>{name}</option>
                ))}
              </select>
            </div>
          ),
      )}
      {supports(robot, "say") && (
        <div class="field">
          <label for="kf-say">{texts.actions.say}</label>
          <input
            id="kf-say"
            type="text"
            data-testid="kf-say"
            maxLength={500}
            value={say ?? ""}
            onInput={(event) => set("say", event.currentTarget.value === "" ? undefined : event.currentTarget.value)}
          />
        </div>
      )}
      {supports(robot, "drive") && (
        <Toggle
          action="drive"
          on={drive !== undefined}
          onToggle={(on) => set("drive", on ? { forward_m_s: 0.1, turn_rad_s: 0, duration_s: 2 } : undefined)}
        >
          {drive !== undefined && (
            <div class="row">
              <NumberField
                id="kf-forward"
                label={texts.forward}
                value={drive.forward_m_s}
                digits={2}
                onSet={(forward_m_s) => set("drive", { ...drive, forward_m_s })}
              />
              <NumberField
                id="kf-turn"
                label={texts.turn}
                value={degrees(drive.turn_rad_s)}
                digits={0}
                onSet={(turn) => set("drive", { ...drive, turn_rad_s: round(radians(turn)) })}
              />
              <NumberField
                id="kf-duration"
                label={texts.duration}
                value={drive.duration_s}
                digits={1}
                onSet={(duration_s) => set("drive", { ...drive, duration_s })}
              />
            </div>
          )}
        </Toggle>
      )}
      {supports(robot, "go_to") && (
        <Toggle action="go_to" on={goal !== undefined} onToggle={(on) => set("go_to", on ? { x_m: 0, y_m: 0 } : undefined)}>
          {goal !== undefined && (
            <div class="row">
              <NumberField id="kf-x" label={texts.x} value={goal.x_m} digits={2} onSet={(x_m) => set("go_to", { ...goal, x_m })} />
              <NumberField id="kf-y" label={texts.y} value={goal.y_m} digits={2} onSet={(y_m) => set("go_to", { ...goal, y_m })} />
              <NumberField
                id="kf-yaw"
                label={texts.yaw}
                value={degrees(goal.yaw_rad ?? 0)}
                digits={0}
                onSet={(yaw) => set("go_to", { ...goal, yaw_rad: round(radians(yaw)) })}
              />
            </div>
          )}
        </Toggle>
      )}
      {supports(robot, "set_control") && (
        <Toggle
          action="set_control"
          on={setting !== undefined}
          onToggle={(on) => set("set_control", on ? { name: robot.controls?.[0]?.name ?? GRIPPER, value: robot.controls?.[0]?.lower ?? 0 } : undefined)}
        >
          {setting !== undefined && (
            <ControlFields
              controls={robot.controls}
              setting={setting}
              onSet={(value) => set("set_control", value)}
              onEnd={() => editor.endGesture()}
            />
          )}
        </Toggle>
      )}
    </fieldset>
  );
}

/** The name that the drivers give to a gripper. */
const GRIPPER = "gripper";
const STEPS = 100;

interface ControlFieldsProps {
  /** `null`: unknown; the name is typed, and the robot checks it. */
  controls: readonly Control[] | null;
  setting: ControlValue;
  onSet: (setting: ControlValue) => void;
  onEnd: () => void;
}

function ControlFields({ controls, setting, onSet, onEnd }: ControlFieldsProps) {
  const { name, value } = setting;
  const control = controls?.find((one) => one.name === name);
  const choose = (chosen: string): void => {
    const limits = controls?.find((one) => one.name === chosen);
    onSet({ name: chosen, value: limits === undefined ? value : clamp(value, limits.lower, limits.upper) });
  };
  return (
    <div class="row">
      <span class="kf-number-field">
        <label for="kf-control">{texts.control}</label>
        {controls === null ? (
          <input
            id="kf-control"
            type="text"
            data-testid="kf-control"
            required
            pattern="[A-Za-z0-9_\-]{1,64}"
            title={texts.controlNames}
            value={name}
            onChange={(event) => event.currentTarget.reportValidity() && choose(event.currentTarget.value)}
          />
        ) : (
          <select id="kf-control" data-testid="kf-control" value={name} onChange={(event) => choose(event.currentTarget.value)}>
            {control === undefined && <option value={name}>{name}</option>}
            {controls.map((one) => (
              <option key={one.name} value={one.name}>
                {one.label}
              </option>
            ))}
          </select>
        )}
      </span>
      {control !== undefined && (
        <input
          type="range"
          data-testid="kf-control-slider"
          aria-label={control.label}
          min={control.lower}
          max={control.upper}
          step={(control.upper - control.lower) / STEPS}
          value={value}
          onInput={(event) => onSet({ name, value: round(event.currentTarget.valueAsNumber) })}
          onChange={onEnd}
        />
      )}
      <NumberField
        id="kf-control-value"
        label={texts.controlValue(control?.unit ?? "")}
        value={value}
        digits={2}
        onSet={(next) => onSet({ name, value: next })}
      />
    </div>
  );
}

function round(value: number): number {
  return Number(value.toFixed(4));
}

interface ToggleProps {
  action: "drive" | "go_to" | "set_control";
  on: boolean;
  onToggle: (on: boolean) => void;
  children: preact.ComponentChildren;
}

function Toggle({ action, on, onToggle, children }: ToggleProps) {
  return (
    <div class="field">
      <label class="check">
        <input type="checkbox" data-testid={`kf-${action}`} checked={on} onChange={(event) => onToggle(event.currentTarget.checked)} />
        {texts.actions[action]}
      </label>
      {children}
    </div>
  );
}
