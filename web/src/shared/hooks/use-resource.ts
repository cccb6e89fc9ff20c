import { useEffect, useState } from "preact/hooks";
import { sentence } from "../api/http";

interface Loaded<T> {
  /** `null` until loaded. */
  value: T | null;
  /** The error, or "". */
  trouble: string;
  again: () => void;
}

/** Loads a resource on mount. A new `load` function reloads it, so callers memoize it. */
export function useResource<T>(load: () => Promise<T>): Loaded<T> {
  const [value, setValue] = useState<T | null>(null);
  const [trouble, setTrouble] = useState("");
  const [tries, setTries] = useState(0);
  useEffect(() => {
    let wanted = true;
    setTrouble("");
    load().then(
      (found) => wanted && setValue(() => found),
      (error: unknown) => wanted && setTrouble(sentence(error)),
    );
    return () => {
      wanted = false;
    };
  }, [load, tries]);
  return { value, trouble, again: () => setTries(tries + 1) };
}
