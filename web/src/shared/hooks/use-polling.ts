/** Polls the cloud while the page is visible. */
import { useCallback, useEffect, useRef, useState } from "preact/hooks";
import { sentence } from "../api/http";

export interface Polled<T> {
  /** The newest response; `null` before the first. */
  value: T | null;
  /** The error of the last call, or "". An error does not clear the previous response. */
  error: string;
  /** Polls immediately. */
  refresh: () => void;
}

/** Polls at an interval, and when one of `keys` changes, which also clears the last response. */
export function usePolling<T>(load: () => Promise<T>, everyMs: number, keys: readonly unknown[]): Polled<T> {
  const [value, setValue] = useState<T | null>(null);
  const [error, setError] = useState("");
  const callCount = useRef(0);
  const newest = useRef(load);
  newest.current = load;
  const refresh = useCallback(() => {
    const call = ++callCount.current;
    newest.current().then(
      (found) => {
        if (call !== callCount.current) return;
        setValue(found);
        setError("");
      },
      (error: unknown) => call === callCount.current && setError(sentence(error)),
    );
  }, []);
  useEffect(() => {
    setValue(null);
    refresh();
    const timer = setInterval(() => {
      if (document.visibilityState === "visible") refresh();
    }, everyMs);
    return () => {
      clearInterval(timer);
      callCount.current += 1;
    };
  }, [refresh, everyMs, ...keys]);
  return { value, error, refresh };
}
