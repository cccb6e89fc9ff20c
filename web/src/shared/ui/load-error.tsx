import { common } from "../i18n/common";

/** A load error with a retry button; empty without an error. */
export function LoadError({ reason, retry }: { reason: string; retry: () => void }) {
  if (reason === "") return null;
  return (
    <p class="notice bad row" role="alert">
      <span>{common.loadFailed(reason)}</span>
      <button type="button" onClick={retry}>
        {common.tryAgain}
      </button>
    </p>
  );
}
