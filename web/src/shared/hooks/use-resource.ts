import { useEffect, useState } from "preact/hooks";
import { sentence } from "../api/http";

interface Loaded<T> {
  /** `null` until it came. */
  value: T | null;
  /** Why it did not come. */
  trouble: string;
  again: () => void;
}

/** What a call brings, asked for when the page opens. `load` has to be the same as long as the same is wanted. */
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
