"""What formats that are source code share: members' names, the contract in a comment, golden rows."""
