"""The 2015 paper by Hayat, Abhishek and Saha: its facts, and their reproduction."""
