import { useEffect, useState } from "preact/hooks";
import { sentence } from "../api/http";

interface Loaded<T> {
  /** `null` until loaded. */
  value: T | null;
  /** The error, or "". */
  error: string;
  reload: () => void;
}

/** Loads a resource on mount. A new `load` function reloads it, so callers memoize it. */
export function useResource<T>(load: () => Promise<T>): Loaded<T> {
  const [value, setValue] = useState<T | null>(null);
  const [error, setError] = useState("");
  const [attempt, setAttempt] = useState(0);
  useEffect(() => {
    let active = true;
    setError("");
    load().then(
      (found) => active && setValue(() => found),
      (error: unknown) => active && setError(sentence(error)),
    );
    return () => {
      active = false;
    };
  }, [load, attempt]);
  return { value, error, reload: () => setAttempt(attempt + 1) };
}
