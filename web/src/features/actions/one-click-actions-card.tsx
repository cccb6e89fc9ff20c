/** Actions with one button: postures, behaviours and expressions. */
import { useState } from "preact/hooks";
import type { AnyRequest } from "../../shared/api/action-requests";
import { texts } from "./texts";
import { startAction, type ActionCardProps } from "./action-cards";
import { FractionField } from "./action-form-fields";

interface ButtonsProps extends ActionCardProps {
  names: readonly string[];
  testid: string;
  request: (name: string) => AnyRequest;
}

function Buttons({ session, disabledReason, names, testid, request }: ButtonsProps) {
  return (
    <div class="act-buttons">
      {names.map((name) => (
        <button
          key={name}
          type="button"
          data-testid={`${testid}-${name}`}
          disabled={disabledReason !== ""}
          title={disabledReason === "" ? undefined : disabledReason}
          onClick={() => startAction(session, request(name))}
        >
          {name}
        </button>
      ))}
    </div>
  );
}

export function PosturesCard(props: ActionCardProps) {
  const [speed, setSpeed] = useState(0.5);
  return (
    <>
      <Buttons
        {...props}
        names={props.description.postures}
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
      names={props.description.behaviours}
      testid="behaviour"
      request={(name) => ({ kind: "run_behaviour", name })}
    />
  );
}

export function ExpressionsCard(props: ActionCardProps) {
  const [strength, setStrength] = useState(1);
  return (
    <>
      <Buttons
        {...props}
        names={props.description.expressions}
        testid="expression"
        request={(name) => ({ kind: "express", name, strength })}
      />
      <FractionField label={texts.strength} value={strength} min={0} onChange={setStrength} testid="strength" />
    </>
  );
}
