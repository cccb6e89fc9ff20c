/** Moving time of operator and machine as one bar. */
import { shareText } from "./model";
import { texts } from "./texts";

interface ShareBarProps {
  operatorS: number;
  machineS: number;
  small?: boolean;
}

/** Without motion, the bar is empty. */
export function ShareBar({ operatorS, machineS, small = false }: ShareBarProps) {
  const movingS = operatorS + machineS;
  const label = movingS === 0 ? texts.notMoved : texts.bar(shareText(operatorS / movingS), shareText(machineS / movingS));
  return (
    <span class={`share-bar ${small ? "small-bar" : ""}`} role="img" aria-label={label} title={label}>
      {operatorS > 0 && <span class="by-operator" style={{ flexGrow: String(operatorS / movingS) }} />}
      {machineS > 0 && <span class="by-machine" style={{ flexGrow: String(machineS / movingS) }} />}
    </span>
  );
}

/** The colour of a source, next to its name. */
export function Key({ source }: { source: "operator" | "machine" }) {
  return <span class={`share-key by-${source}`} aria-hidden="true" />;
}
