// What snippets use of TensorFlowSharp. A run answers what was recorded, and prints what it was fed.
using System;
using System.Collections.Generic;

namespace TensorFlow
{
    public class TFOutput { public string Name; }

    public class TFOperation
    {
        public string Name;
        public TFOutput this[int number] { get { return new TFOutput { Name = Name }; } }
    }

    public class TFGraph
    {
        public void Import(byte[] data) { if (data.Length == 0) throw new Exception("empty graph"); }
        public TFOperation this[string name] { get { return new TFOperation { Name = name }; } }
    }

    public class TFTensor
    {
        readonly object value;
        public TFTensor(object value) { this.value = value; }
        public object GetValue() { return value; }
        public static implicit operator TFTensor(Array value) { return new TFTensor(value); }
    }

    public class TFSession : IDisposable
    {
        public TFSession(TFGraph graph) { }
        public Runner GetRunner() { return new Runner(); }
        public void Dispose() { }

        public class Runner
        {
            readonly List<TFTensor> fetched = new List<TFTensor>();
            public void AddInput(TFOutput input, TFTensor value) { Recorded.Fed(input.Name, (Array)value.GetValue()); }
            public void Fetch(TFOutput output) { fetched.Add(new TFTensor(Recorded.Answer(output.Name))); }
            public TFTensor[] Run() { Recorded.Step++; return fetched.ToArray(); }
        }
    }
}
