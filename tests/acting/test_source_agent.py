"""The snippet of an agent whose decisions are a policy's C# class, compiled and run with stubs of ML-Agents."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from export_model.converters.runtimes.csharp import tools
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.snippets.contract import read_bundle
from export_model.exporter.snippets.registry import snippets
from fixtures import FIXTURES, path

#: What of ML-Agents' C# interface an agent calls; no more than names and types.
STUBS = """
namespace Unity.MLAgents.Actuators
{
    public struct ActionSegment<T>
    {
        public readonly T[] Array;
        public ActionSegment(T[] array) { Array = array; }
        public int Length { get { return Array.Length; } }
        public T this[int i] { get { return Array[i]; } set { Array[i] = value; } }
    }
    public struct ActionBuffers
    {
        public ActionSegment<float> ContinuousActions;
        public ActionSegment<int> DiscreteActions;
    }
}
namespace Unity.MLAgents
{
    public class Agent
    {
        public System.Collections.ObjectModel.ReadOnlyCollection<float> Seen;
        public System.Collections.ObjectModel.ReadOnlyCollection<float> GetObservations() { return Seen; }
        public virtual void OnEpisodeBegin() { }
        public virtual void Heuristic(in Actuators.ActionBuffers actionsOut) { }
    }
}
static class Program
{
    static void Main()
    {
        var agent = new TYPE();
        agent.Seen = new System.Collections.ObjectModel.ReadOnlyCollection<float>(new float[SIZE]);
        agent.OnEpisodeBegin();
        var actions = new Unity.MLAgents.Actuators.ActionBuffers();
        actions.ContinuousActions = new Unity.MLAgents.Actuators.ActionSegment<float>(new float[CONTINUOUS]);
        actions.DiscreteActions = new Unity.MLAgents.Actuators.ActionSegment<int>(new int[BRANCHES]);
        for (int i = 0; i < 3; i++) agent.Heuristic(in actions);
        foreach (var x in actions.ContinuousActions.Array) System.Console.WriteLine(x);
        foreach (var x in actions.DiscreteActions.Array) System.Console.WriteLine(x);
    }
}
"""


@pytest.mark.parametrize("name", FIXTURES)
def test_an_agent_of_source_code_compiles_and_decides(name: str, tmp_path: Path) -> None:
    """By Mono, with stubs of ML-Agents: every continuous action within -1 and 1, every class in its branch."""
    found = tools()
    if found is None:
        pytest.skip("mono is not installed: sudo apt-get install mono-mcs mono-runtime")
    result = next(iter(export([path(name)], ExportOptions(tmp_path / "out", ("csharp",), verify="none"))))
    bundle = read_bundle(result.folder)
    (made,), _ = snippets(bundle, "source-agent")
    code = made.code
    shutil.copy(result.folder / f"{bundle.name}.cs", tmp_path / "policy.cs")
    (tmp_path / "agent.cs").write_text(code)
    (kind,) = re.findall(r"class (\w+) : Agent", code)
    vector = next(s for s in bundle.signature.observations if len(s.shape) == 2)
    continuous = sum(h.shape[-1] or 0 for h in bundle.heads if h.is_continuous)
    branches = bundle.signature.branches
    words = {"TYPE": kind, "SIZE": vector.shape[-1], "CONTINUOUS": continuous, "BRANCHES": len(branches)}
    stubs = STUBS
    for word, value in words.items():
        stubs = stubs.replace(word, str(value))
    (tmp_path / "stubs.cs").write_text(stubs)
    command = [found[0], "-langversion:7.2", "-out:agent.exe", "agent.cs", "policy.cs", "stubs.cs"]
    subprocess.run(command, check=True, cwd=tmp_path)
    done = subprocess.run([found[1], "agent.exe"], check=True, cwd=tmp_path, capture_output=True, text=True)
    numbers = [float(line) for line in done.stdout.split()]
    assert len(numbers) == continuous + len(branches)
    assert all(-1 <= x <= 1 for x in numbers[:continuous])
    assert all(0 <= x < size for x, size in zip(numbers[continuous:], branches, strict=True))
