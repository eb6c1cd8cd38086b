// What snippets use of Unity's Inference Engine. A worker answers what was recorded, and prints what it was fed.
using System;
using System.Linq;

namespace UnityEngine
{
    public class MonoBehaviour { }
}

namespace Unity.InferenceEngine
{
    public class ModelAsset { }
    public class Model { }
    public enum BackendType { CPU }
    public static class ModelLoader { public static Model Load(ModelAsset asset) { return new Model(); } }

    public class TensorShape
    {
        public readonly int[] Lengths;
        public TensorShape(params int[] lengths) { Lengths = lengths; }
    }

    public class Tensor : IDisposable { public Array Values; public void Dispose() { } }

    public class Tensor<T> : Tensor
    {
        public Tensor(TensorShape shape, T[] values)
        {
            if (values.Length != shape.Lengths.Aggregate(1, (a, b) => a * b)) throw new Exception("another size");
            Values = values;
        }
        public Tensor<T> ReadbackAndClone() { return this; }
        public T[] DownloadToArray() { return (T[])Values; }
    }

    public class Worker : IDisposable
    {
        public Worker(Model model, BackendType backend) { }
        public void SetInput(string name, Tensor value) { Recorded.Fed(name, value.Values); }
        public void Schedule() { }
        public Tensor PeekOutput(string name)
        {
            var values = Recorded.Answer(name).Cast<object>().ToArray();
            if (Recorded.IsFloat(name)) return Made(values.Select(x => Convert.ToSingle(x)).ToArray());
            return Made(values.Select(x => Convert.ToInt32(x)).ToArray());
        }
        static Tensor<T> Made<T>(T[] values) { return new Tensor<T>(new TensorShape(values.Length), values); }
        public void Dispose() { }
    }
}
