import { useState } from "preact/hooks";
import { format } from "../../shared/i18n/format";
import { texts } from "./texts";
import { startAction, type ActionCardProps } from "./action-cards";
import { FractionField } from "./action-form-fields";

const ALL = "";

/** Sets joint stiffness. The current values come from the device. */
export function StiffnessCard({ session, description, disabledReason }: ActionCardProps) {
  const [joint, setJoint] = useState(ALL);
  const [value, setValue] = useState(1);
  const { device } = session;
  const canStand = description.postures.some((name) => name.startsWith("Stand"));
  const set = (fraction: number): void =>
    startAction(session, { kind: "set_stiffness", value: fraction, joints: joint === ALL ? [] : [joint] });
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
      <FractionField label={texts.stiffness} value={value} min={0} onChange={setValue} testid="stiffness-value" />
      {canStand && value < 0.3 && <p class="notice warn">{texts.limpWarning}</p>}
      <div class="row">
        <button
          type="button"
          data-testid="stiffness-set"
          disabled={disabledReason !== ""}
          title={disabledReason === "" ? undefined : disabledReason}
          onClick={() => set(value)}
        >
          {value === 0 ? texts.release : texts.set}
        </button>
        <button
          type="button"
          data-testid="stiffness-full"
          disabled={disabledReason !== ""}
          title={disabledReason === "" ? undefined : disabledReason}
          onClick={() => {
            setValue(1);
            set(1);
          }}
        >
          {texts.fullStiffness}
        </button>
      </div>
      <ReportedStiffness stiffness={device.state.value?.stiffness ?? null} live={device.live.value} />
    </div>
  );
}

/** The device reports only joints with reduced stiffness. */
function ReportedStiffness({ stiffness, live }: { stiffness: Readonly<Record<string, number>> | null; live: boolean }) {
  if (stiffness === null) return <p class="quiet small">{texts.stiffnessUnknown}</p>;
  const reduced = Object.entries(stiffness);
  return (
    <p class={`small ${live ? "quiet" : "old"}`} data-testid="stiffness-reported" data-reduced={reduced.length}>
      {reduced.length === 0
        ? texts.allFullStiffness
        : texts.reducedStiffness(reduced.map(([name, value]) => `${name} ${format.percent(value)}`).join(", "))}
    </p>
  );
}
