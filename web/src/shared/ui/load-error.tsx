import { common } from "../i18n/common";

/** A load error with a retry button; empty without an error. */
export function LoadError({ said, again }: { said: string; again: () => void }) {
  if (said === "") return null;
  return (
    <p class="notice bad row" role="alert">
      <span>{common.loadFailed(said)}</span>
      <button type="button" onClick={again}>
        {common.tryAgain}
      </button>
    </p>
  );
}
