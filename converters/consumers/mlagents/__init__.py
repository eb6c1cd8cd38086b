"""ML-Agents as a consumer: what its C# side feeds and fetches, by API version, and policies made to fit."""
