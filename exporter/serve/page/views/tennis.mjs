/** One court from above. */

import { follow, HALF_RACKET, Tennis, TIME_STEP } from "../scenes/tennis.mjs";
import { between, disc, rounded } from "./drawing.mjs";

const OBSERVATIONS = ["own racket y", "ball's distance", "ball y", "ball's approach", "ball speed y"];

/** @param {{side: "left" | "right", opponent: string | null}} site which brain the page's policy is */
export function viewOf({ side, opponent }) {
  const other = side === "left" ? "right" : "left";
  const failed = (tally) => tally.missed[side === "left" ? 0 : 1];
  const players = opponent === null ? ["model"] : ["model", "opponent"];
  const against = opponent ?? "a player that follows the ball (the other brain's bundle is not next to this one)";
  return {
    name: "Tennis",
    story: `The policy plays on the ${side}, against ${against}. A point ends when one of them misses.`,
    poke: "Deflect the ball",
    stepSeconds: TIME_STEP,
    agents: 1,
    ratio: (width) => (width < 560 ? 1.05 : 1.72),
    labels: { observations: OBSERVATIONS, branches: [["stay", "up", "down"]], actions: ["racket speed"] },
    create: () => new Tennis(1),
    players,
    observed: (observation, player) => observation[player === "model" ? side : other],
    actions({ model, opponent: second }, observation) {
      const theirs = second ?? follow(other, observation[other]);
      const [left, right] = side === "left" ? [model, theirs] : [theirs, model];
      return { discrete: left.discrete, continuous: right.continuous };
    },
    failed,
    count: (tally) => `missed ${failed(tally)}`,
    status(env, tally) {
      return `rally ${env.rally[0]} · best ${tally.best} · missed: left ${tally.missed[0]}, right ${tally.missed[1]}`;
    },
    describe(env, tally) {
      const [x, y] = env.ball[0];
      const where = x < 0 ? "left" : "right";
      return (
        `A court from above with a racket on each side; the policy plays on the ${side}. The ball is in the ${where} half, ` +
        `${Math.abs(y).toFixed(1)} metres ${y < 0 ? "below" : "above"} the middle. ${env.rally[0]} returns in a row, ${tally.best} at best.`
      );
    },
    draw: (context, size, before, after, share, colours) => draw(context, size, before, after, share, colours, side),
  };
}

function draw(context, { width, height }, before, after, share, colours, side) {
  const margin = Math.min(width, height) * 0.09;
  const [wide, tall] = [width - 2 * margin, height - 2 * margin];
  const at = ([x, y]) => [margin + ((x + 1) / 2) * wide, margin + ((1 - y) / 2) * tall];
  rounded(context, margin - 14, margin - 10, wide + 28, tall + 20, 12);
  context.fillStyle = colours.paper;
  context.fill();
  context.strokeStyle = colours.rule;
  context.lineWidth = 1;
  context.stroke();
  context.setLineDash([6, 7]);
  context.beginPath();
  context.moveTo(...at([0, 1]));
  context.lineTo(...at([0, -1]));
  context.stroke();
  context.setLineDash([]);
  const rackets = between(before, after, "racket", 0, share);
  [-1, 1].forEach((x, i) => {
    const [px, py] = at([x, rackets[i] + HALF_RACKET]);
    const [, end] = at([x, rackets[i] - HALF_RACKET]);
    const own = (side === "left") === (i === 0);
    rounded(context, px - 5, py, 10, end - py, 5);
    context.fillStyle = own ? colours.accent : colours.soft;
    context.fill();
  });
  context.fillStyle = colours.ball;
  disc(context, ...at(between(before, after, "ball", 0, share)), 9);
  context.fill();
}
