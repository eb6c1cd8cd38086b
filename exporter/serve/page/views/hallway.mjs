/** Four halls from above: walkers go right; the left door is above, the right one below. */

import { Hallway, LEFT, LONGEST } from "../scenes/hallway.mjs";
import { between, disc, places, rounded } from "./drawing.mjs";

const AGENTS = 4;
const COLUMNS = LONGEST + 3; // the hall, a place for the cue, the doors

const view = {
  name: "Hallway",
  story:
    "A sign (an arrow) at the start says which door is right. It is seen for one step only, so the policy must remember it. " +
    "Make it forget, and it guesses.",
  poke: "Make it forget",
  pokes: "memory",
  stepSeconds: 0.35,
  agents: AGENTS,
  ratio: (width) => (width < 560 ? 0.95 : 2.1),
  labels: {
    observations: ["sign says left", "sign says right", "way ahead / 8", "at the doors"],
    branches: [["forward", "left", "right"]],
  },
  create: () => new Hallway(AGENTS),
  players: ["model"],
  observed: (observation) => observation,
  actions: ({ model }) => model,
  count: (tally) => `wrong or timed out ${tally.bad}`,
  status: (env, tally) => `correct ${tally.good}`,
  describe(env, tally, chosen) {
    const side = env.door[chosen] === LEFT ? "left" : "right";
    return (
      `${AGENTS} halls with two doors at the end. ${tally.good} walkers took the right door so far, ${tally.bad} did not. In hall ` +
      `${chosen + 1} the ${side} door is right, and the walker has ${env.ahead[chosen]} steps to go.`
    );
  },
  draw,
};

export const viewOf = () => view;

function draw(context, { width, height }, before, after, share, colours, chosen) {
  const all = places(AGENTS, width, height, { ratio: 3.4, gap: 20 });
  all.forEach((place, i) => hall(context, place, i, before, after, share, colours, i === chosen));
}

function hall(context, { x, y, width, height }, i, before, after, share, colours, isChosen) {
  const cell = width / COLUMNS;
  const middle = y + height / 2;
  const begins = x + (1 + LONGEST - after.length[i]) * cell;
  const doors = x + (LONGEST + 2) * cell;
  const half = 0.62 * cell;
  // The corridor, and the room across its end.
  context.fillStyle = colours.paper;
  context.strokeStyle = isChosen ? colours.accent : colours.rule;
  context.lineWidth = isChosen ? 2.5 : 1;
  context.beginPath();
  context.moveTo(begins - half, middle - half);
  for (const [px, py] of [
    ...[[doors - half, middle - half], [doors - half, y + 2], [doors + half, y + 2], [doors + half, y + height - 2]],
    ...[[doors - half, y + height - 2], [doors - half, middle + half], [begins - half, middle + half]],
  ]) {
    context.lineTo(px, py);
  }
  context.closePath();
  context.fill();
  context.stroke();
  const went = after.went[i];
  [LEFT, LEFT + 1].forEach((side) => {
    const top = side === LEFT ? y + 2 : y + height - 2 - 0.3 * cell;
    const isTaken = went !== null && went.side === side;
    rounded(context, doors - 0.5 * cell, top, cell, 0.3 * cell, 3);
    context.fillStyle = isTaken ? (went.won ? colours.good : colours.bad) : colours.soft;
    context.fill();
    if (isTaken) label(context, went.won ? "✓" : "✗", doors, top + (side === LEFT ? 0.75 : -0.45) * cell, cell, context.fillStyle);
  });
  // The sign: bold while it is seen, faint when it is only for us.
  const isSeen = after.isFirst[i];
  const up = after.door[i] === LEFT;
  context.globalAlpha = isSeen ? 1 : 0.28;
  arrow(context, begins - half - 0.6 * cell, middle, cell, up ? -1 : 1, colours.ball);
  context.globalAlpha = 1;
  const ahead = between(before, after, "ahead", i, share);
  context.fillStyle = colours.accent;
  disc(context, doors - ahead * cell, middle, 0.36 * cell);
  context.fill();
}

function arrow(context, x, y, cell, way, colour) {
  context.fillStyle = colour;
  context.beginPath();
  context.moveTo(x, y + way * 0.5 * cell);
  context.lineTo(x - 0.36 * cell, y - way * 0.3 * cell);
  context.lineTo(x + 0.36 * cell, y - way * 0.3 * cell);
  context.closePath();
  context.fill();
}

function label(context, words, x, y, cell, colour) {
  context.fillStyle = colour;
  context.font = `600 ${Math.max(0.8 * cell, 12)}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(words, x, y);
}
