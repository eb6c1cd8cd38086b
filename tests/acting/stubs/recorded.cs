// What a policy answered to zeros, step by step, in place of a runtime that this machine lacks.
using System;
using System.Collections.Generic;
using System.Globalization;
using System.Linq;

public static class Recorded
{
    public static string Policy;
    public static int Step;
    public static readonly Dictionary<string, Array> Answers = new Dictionary<string, Array>();

    public static void Add(string key, Type type, int[] shape, double[] numbers)
    {
        var made = Array.CreateInstance(type, shape);
        var place = new int[shape.Length];
        foreach (var number in numbers)
        {
            made.SetValue(Convert.ChangeType(number, type), place);
            for (var axis = shape.Length - 1; axis >= 0 && ++place[axis] == shape[axis]; axis--) place[axis] = 0;
        }
        Answers[key] = made;
    }

    public static Array Answer(string name) { return Answers[Policy + "/" + Step + "/" + name]; }

    public static bool IsFloat(string name) { return Answer(name).GetType().GetElementType() == typeof(float); }

    public static void Fed(string name, Array values) { Print("fed " + name, values); }

    public static void Print(string what, Array values)
    {
        var numbers = values.Cast<object>().Select(x => Convert.ToDouble(x).ToString("R", CultureInfo.InvariantCulture));
        Console.WriteLine("> " + Policy + " " + what + " " + string.Join(",", numbers));
    }
}
