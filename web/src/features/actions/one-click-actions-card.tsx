/** Actions with one button: postures, behaviours and expressions. */
import { useState } from "preact/hooks";
import type { AnyRequest } from "../../shared/api/action-requests";
import { texts } from "./texts";
import { startAction, type ActionCardProps } from "./action-cards";
import { FractionField } from "./action-form-fields";
import { type BehaviourButton, behaviourButtons } from "./model";

interface ButtonsProps extends ActionCardProps {
  buttons: readonly BehaviourButton[];
  testid: string;
  request: (name: string) => AnyRequest;
}

function Buttons({ session, disabledReason, buttons, testid, request }: ButtonsProps) {
  return (
    <div class="act-buttons">
      {buttons.map(({ name, label }) => (
        <button
          key={name}
          type="button"
          data-testid={`${testid}-${name}`}
          disabled={disabledReason !== ""}
          title={disabledReason === "" ? undefined : disabledReason}
          onClick={() => startAction(session, request(name))}
        >
          {label}
        </button>
      ))}
    </div>
  );
}

const named = (names: readonly string[]): BehaviourButton[] => names.map((name) => ({ name, label: name }));

export function PosturesCard(props: ActionCardProps) {
  const [speed, setSpeed] = useState(0.5);
  return (
    <>
      <Buttons
        {...props}
        buttons={named(props.description.postures)}
        testid="posture"
        request={(name) => ({ kind: "take_posture", name, speed })}
      />
      <FractionField label={texts.speed} value={speed} min={0.1} onChange={setSpeed} />
    </>
  );
}

export function BehavioursCard(props: ActionCardProps) {
  return (
    <Buttons
      {...props}
      buttons={behaviourButtons(props.description).behaviours}
      testid="behaviour"
      request={(name) => ({ kind: "run_behaviour", name })}
    />
  );
}

/** Recoveries of a robot that has stopped itself. */
export function RecoveriesCard(props: ActionCardProps) {
  return (
    <>
      <p class="quiet small">{texts.recoveriesNote}</p>
      <Buttons
        {...props}
        buttons={behaviourButtons(props.description).recoveries}
        testid="recovery"
        request={(name) => ({ kind: "run_behaviour", name })}
      />
    </>
  );
}

export function ExpressionsCard(props: ActionCardProps) {
  const [strength, setStrength] = useState(1);
  return (
    <>
      <Buttons
        {...props}
        buttons={named(props.description.expressions)}
        testid="expression"
        request={(name) => ({ kind: "express", name, strength })}
      />
      <FractionField label={texts.strength} value={strength} min={0} onChange={setStrength} testid="strength" />
    </>
  );
}
