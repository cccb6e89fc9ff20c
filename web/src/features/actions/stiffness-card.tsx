import { useState } from "preact/hooks";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { startAction, type ActionCardProps } from "./action-cards";
import { ShareField } from "./action-form-fields";

const ALL = "";

/** Sets joint stiffness. The current values come from the device. */
export function StiffnessCard({ session, description, no }: ActionCardProps) {
  const [joint, setJoint] = useState(ALL);
  const [value, setValue] = useState(1);
  const { device } = session;
  const stands = description.postures.some((name) => name.startsWith("Stand"));
  const set = (share: number): void =>
    startAction(session, { kind: "set_stiffness", value: share, joints: joint === ALL ? [] : [joint] });
  return (
    <div class="act-form">
      <label>
        {texts.joint}{" "}
        <select value={joint} data-testid="stiffness-joint" onChange={(event) => setJoint(event.currentTarget.value)}>
          <option value={ALL}>{texts.allJoints}</option>
          {description.joints.map(({ name, label }) => (
            <option key={name} value={name}>
              {label}
            </option>
          ))}
        </select>
      </label>
      <ShareField label={texts.stiffness} value={value} least={0} onChange={setValue} testid="stiffness-value" />
      {stands && value < 0.3 && <p class="notice warn">{texts.limpWarning}</p>}
      <div class="row">
        <button
          type="button"
          data-testid="stiffness-set"
          disabled={no !== ""}
          title={no === "" ? undefined : no}
          onClick={() => set(value)}
        >
          {value === 0 ? texts.letGo : texts.set}
        </button>
        <button
          type="button"
          data-testid="stiffness-full"
          disabled={no !== ""}
          title={no === "" ? undefined : no}
          onClick={() => {
            setValue(1);
            set(1);
          }}
        >
          {texts.holdFully}
        </button>
      </div>
      <Told told={device.state.value?.stiffness ?? null} live={device.live.value} />
    </div>
  );
}

/** The device reports only joints with reduced stiffness. */
function Told({ told, live }: { told: Readonly<Record<string, number>> | null; live: boolean }) {
  if (told === null) return <p class="quiet small">{texts.stiffnessUnknown}</p>;
  const less = Object.entries(told);
  return (
    <p class={`small ${live ? "quiet" : "old"}`} data-testid="stiffness-told" data-less={less.length}>
      {less.length === 0
        ? texts.holdsFully
        : texts.holdsLess(less.map(([name, value]) => `${name} ${format.percent(value)}`).join(", "))}
    </p>
  );
}
