import { useEffect, useRef, useState } from "preact/hooks";
import type { RefObject } from "preact";
import type { KnownTwin } from "../../shared/mqtt/parse-messages";
import { texts } from "./texts";
import type { LiveScene } from "./scene";
import { onColourChange } from "../../shared/ui/canvas-theme";

interface SceneView {
  canvas: RefObject<HTMLCanvasElement | null>;
  /** The element with the frame counter `data-frames`. */
  box: RefObject<HTMLDivElement | null>;
  scene: LiveScene | null;
  trouble: "no-webgl" | "failed" | null;
  /** The error, or "". */
  said: string;
}

/** A twin's scene on a canvas, loaded when visible. */
export function useScene(twin: KnownTwin | null): SceneView {
  const canvas = useRef<HTMLCanvasElement>(null);
  const box = useRef<HTMLDivElement>(null);
  const [scene, setScene] = useState<LiveScene | null>(null);
  const [trouble, setTrouble] = useState<SceneView["trouble"]>(null);

  useEffect(() => {
    if (twin === null) return;
    let wanted = true;
    let made: LiveScene | null = null;
    let frames = 0;
    const start = async (): Promise<void> => {
      try {
        const { createScene, NoWebglError } = await import("./scene");
        if (!wanted || canvas.current === null) return;
        try {
          made = createScene(canvas.current, twin, () => {
            frames += 1;
            box.current?.setAttribute("data-frames", String(frames));
          });
          setScene(made);
          setTrouble(null);
        } catch (error) {
          setTrouble(error instanceof NoWebglError ? "no-webgl" : "failed");
        }
      } catch {
        setTrouble("failed");
      }
    };
    void start();
    const forget = onColourChange(() => made?.recolour());
    return () => {
      wanted = false;
      forget();
      made?.dispose();
      setScene(null);
    };
  }, [twin]);

  const said = trouble === null ? "" : trouble === "no-webgl" ? texts.view.noWebgl : texts.view.failed;
  return { canvas, box, scene, trouble, said };
}
