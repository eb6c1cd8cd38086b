// What recorders use of UnityEngine and com.unity.ml-agents, by their public documentation.
using System.Collections;
using System.Collections.Generic;
using System.Collections.ObjectModel;

namespace UnityEngine
{
    public class MonoBehaviour
    {
        public static object There;
        public T GetComponent<T>() { return (T)There; }
    }
}

namespace Unity.MLAgents.Actuators
{
    public struct ActionSegment<T> : IEnumerable<T> where T : struct
    {
        readonly T[] array;
        public ActionSegment(T[] array) { this.array = array; }
        IEnumerator<T> IEnumerable<T>.GetEnumerator() { return ((IEnumerable<T>)array).GetEnumerator(); }
        IEnumerator IEnumerable.GetEnumerator() { return array.GetEnumerator(); }
    }

    public struct ActionBuffers
    {
        public ActionSegment<float> ContinuousActions { get; }
        public ActionSegment<int> DiscreteActions { get; }
        public ActionBuffers(float[] continuous, int[] discrete)
        {
            ContinuousActions = new ActionSegment<float>(continuous);
            DiscreteActions = new ActionSegment<int>(discrete);
        }
    }
}

namespace Unity.MLAgents
{
    public class Agent : UnityEngine.MonoBehaviour
    {
        public float[] Seen = new float[0];
        public int Episodes;
        public int CompletedEpisodes { get { return Episodes; } }
        public ReadOnlyCollection<float> GetObservations() { return new ReadOnlyCollection<float>(Seen); }
    }
}
